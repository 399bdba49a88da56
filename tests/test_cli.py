"""The command line: what it prints, leaves, refuses and survives."""

import json
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import gradscape
from gradscape.envs.bounce import Bounce

from .command import Said, modules, needs_taichi
from .processes import Instant, alone, landscape


@pytest.mark.parametrize("arguments", [["--help"], ["slice", "--help"], ["envs"]])
def test_help_and_table_import_nothing_heavy(arguments: list[str]) -> None:
    heavy = {"torch", "warp", "taichi", "numpy", "matplotlib", "xarray", "zarr", "botorch", "pyvista", "rerun"}
    assert not heavy & modules(arguments)


@pytest.mark.parametrize("arguments", [[], ["gallery"]])
def test_a_command_alone_is_its_help(run: Callable[..., Said], tmp_path: Path, arguments: list[str]) -> None:
    alone = run(*arguments, cwd=tmp_path)
    assert (alone.returncode, alone.stderr) == (0, "")
    assert alone.stdout == run(*arguments, "--help", cwd=tmp_path).stdout
    assert alone.stdout.startswith(" ".join(["Usage: landscape", *arguments, "COMMAND"]))
    assert len(alone.stdout.splitlines()) > 8


def test_a_word_too_few_or_too_many_says_where_to_read_on(run: Callable[..., Said], tmp_path: Path) -> None:
    for arguments in (["slice"], ["slice", "fluid", "--dimz", "0"], ["slice", "fluid", "--resolution", "x"]):
        assert "(`landscape slice --help` says what it takes)" in run(*arguments, cwd=tmp_path).stderr
    assert "(`landscape --help` says what it takes)" in run("plot", cwd=tmp_path).stderr


@pytest.mark.drawn
def test_slice_leaves_store_picture_and_summary(run: Callable[..., Said], tmp_path: Path) -> None:
    done = run("slice", "branin", "--dims", "x0", "1", "--resolution", "9", "--json", "--out", "cut", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary == {**json.loads((tmp_path / "cut/summary.json").read_text()), "folder": "cut"}
    assert summary["env"] == "branin"
    assert summary["dims"] == ["x0", "x1"]
    assert summary["episodes"] == summary["status"]["ok"] == 81
    dataset = gradscape.open_slice(tmp_path / "cut/slice.zarr").data
    assert dataset["grad"].shape == (9, 9, 2)
    assert summary["loss"]["lowest"] == float(dataset["loss"].min())
    assert (tmp_path / "cut/landscape.png").read_bytes().startswith(b"\x89PNG")
    assert "81 episodes with gradients to compute: about" in done.stderr


def test_slice_says_where_the_gradient_is_exactly_zero(run: Callable[..., Said], tmp_path: Path) -> None:
    done = run("slice", "pinball-2", "--dims", "0", "1", "--resolution", "9", "--json", "--out", "cut", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    dataset = gradscape.open_slice(tmp_path / "cut/slice.zarr").data
    flat = int((dataset["grad"] == 0).all("dim").sum())
    assert json.loads(done.stdout)["flat"] == flat
    assert 0 < flat < 81
    assert f"gradient exactly zero at {flat / 81:.1%} of points" in done.stderr


def test_same_command_computes_nothing_twice_and_force_begins_anew(run: Callable[..., Said], tmp_path: Path) -> None:
    command = ["slice", "branin", "--dims", "0", "1", "--resolution", "5", "--json"]
    assert json.loads(run(*command, cwd=tmp_path).stdout)["episodes"] == 25
    again = run(*command, cwd=tmp_path)
    assert json.loads(again.stdout)["episodes"] == 0
    assert "there already" in again.stderr
    assert json.loads(run(*command, "--force", cwd=tmp_path).stdout)["episodes"] == 25


def test_another_slice_is_not_overwritten(run: Callable[..., Said], tmp_path: Path) -> None:
    first = ["slice", "branin", "--dims", "0", "1", "--resolution", "5", "--out", "cut"]
    run(*first, cwd=tmp_path)
    before = (tmp_path / "cut/summary.json").read_bytes()
    other = run("slice", "beale", "--dims", "0", "1", "--resolution", "5", "--out", "cut", cwd=tmp_path)
    assert other.returncode == 2
    assert "wanted 'beale', found 'branin'" in other.stderr
    assert (tmp_path / "cut/summary.json").read_bytes() == before


def test_a_folder_of_other_files_is_left_alone(run: Callable[..., Said], tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/landscape.png").write_text("precious")
    for extra in ([], ["--force"]):
        done = run("slice", "branin", "--dims", "0", "1", "--out", "mine", *extra, cwd=tmp_path)
        assert done.returncode == 2
        assert (tmp_path / "mine/landscape.png").read_text() == "precious"


BAD_INPUT = [
    (["slice", "flud", "--dims", "0", "1"], "did you mean fluid?"),
    (["slice", "bounce"], "--dims"),
    (["slice", "branin", "--dims", "0", "2"], "numbered 0 to 1; got 2"),
    (["slice", "branin", "--dims", "0", "0"], "two different parameters; got 0, 0"),
    (["slice", "branin", "--dims", "0", "1", "--resolution", "1"], "--resolution"),
    (["slice", "branin", "--dims", "0", "1", "--fidelity", "best"], "has fidelities exact; got 'best'"),
    (["slice", "branin", "--dims", "0", "1", "--device", "tpu"], "got device 'tpu'"),
    (
        ["slice", "branin", "--dims", "0", "1", "--through", "nowhere"],
        "center, random:SEED, example:NAME, best, best:RUN, a file",
    ),
    (["slice", "branin", "--dims", "0", "1", "--through", "example:x"], "branin has no example 'x'"),
    (["slice", "branin", "--dims", "0", "1", "--window", "wide"], "got 'wide'"),
    (["slice", "branin", "--window", "-15:wide"], "got '-15:wide'"),
    (["slice", "branin", "--resolution", "8.5"], "--resolution: not a whole number: 8.5"),
    (["slice", "branin", "extra"], "unexpected: extra"),
    (["slice", "branin", "--dims", "0", "1", "--set", "dim=3"], "branin has no option 'dim'"),
    (
        ["slice", "ackley", "--dims", "0", "1", "--set", "dim=two"],
        "dim takes a whole number above 0, at most 100000; got 'two'",
    ),
    (["slice", "ackley", "--dims", "0", "1", "--set", "dim"], "--set takes name=value; got 'dim'"),
    (["slice", "bounce", "--dims", "0", "1", "--engine", "taichi"], "bounce has engine warp; got engine 'taichi'"),
    (["bench", "bonce"], "did you mean bounce?"),
    (["bench", "bounce", "--engine", "taichi"], "bounce has engine warp; got engine 'taichi'"),
    (["bench", "bounce", "--second-engine", "taichi"], "bounce has engine warp; got engine 'taichi'"),
    (["bench", "fluid", "--second-engine", "warp"], "two engines are compared; got warp against warp"),
    (["bench", "bounce", "--batch", "0"], "--batch"),
    (["bench", "bounce", "--set", "wind=1"], "bounce has no option 'wind'"),
    (["bounce", "--axis", "w"], "axis x, y or z; got 'w'"),
    (["envs", "nothing"], "no environment is called 'nothing'"),
    (["plot"], "plot"),
]


def test_bad_input_gets_one_line_and_exit_code_2(run: Callable[..., Said], tmp_path: Path) -> None:
    for arguments, said in BAD_INPUT:
        done = run(*arguments, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (2, ""), arguments
        assert done.stderr.startswith("landscape: "), arguments
        assert len(done.stderr.splitlines()) == 1, arguments
        assert said in done.stderr, arguments
        assert not list(tmp_path.iterdir()), arguments


@pytest.mark.parametrize("verb", [("slice",), ("study", "convergence"), ("check",)])
def test_a_device_without_memory_for_a_point_is_one_line_and_exit_code_1(
    run: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: tuple[str, ...]
) -> None:
    def full(*_: object, **__: object) -> None:
        raise RuntimeError("Failed to allocate 18792000 bytes on device 'cuda:0'")

    monkeypatch.setattr(Bounce, "_evaluate", full)
    dims = ["--dims", "0", "1", "--resolution", "4"] if verb == ("slice",) else []
    done = run(*verb, "bounce", *dims, cwd=tmp_path)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith("landscape: ")
    assert "out of memory" in last
    assert "Failed to allocate 18792000 bytes" in last
    assert last.endswith("take a lower --fidelity or another --device")


@pytest.mark.parametrize(("name", "text"), [("p.json", "[1.5, 2.5]"), ("p.txt", "1.5 2.5\n"), ("p.csv", "1.5,2.5\n")])
def test_a_slice_goes_through_the_point_in_a_file(
    run: Callable[..., Said], tmp_path: Path, name: str, text: str
) -> None:
    (tmp_path / name).write_text(text)
    arguments = ["--through", name, "--window", "0.1", "--resolution", "3", "--out", "cut", "--no-gradients"]
    assert run("slice", "branin", "--dims", "0", "1", *arguments, cwd=tmp_path).returncode == 0
    dataset = gradscape.open_slice(tmp_path / "cut/slice.zarr").data
    assert "grad" not in dataset
    assert (float(dataset["u"][1]), float(dataset["v"][1])) == (1.5, 2.5)


@pytest.mark.drawn
def test_bounce_counts_the_bounces_it_marks(run: Callable[..., Said], tmp_path: Path) -> None:
    done = run("bounce", "--axis", "y", "--resolution", "64", "--json", "--out", "b", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["dims"] == ["velocity y"]
    assert summary["status"]["ok"] == 64
    assert (tmp_path / "b/landscape.png").exists()


@pytest.mark.slow
@needs_taichi
def test_bench_prints_rates_ratios_and_memory_as_json(run: Callable[..., Said], tmp_path: Path) -> None:
    command = ["bench", "swing-velocity", "--second-engine", "taichi", "--batch", "2", "--seconds", "0"]
    done = run(*command, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert (report["env"], report["fidelity"], report["engine"]) == ("swing-velocity", "draft", "warp")
    scene = gradscape.make("swing-velocity", device="cpu")
    fidelity = scene.fidelity
    vertices, steps = (fidelity.resolution + 1) ** 2, round(scene.duration / fidelity.dt)
    assert report["work"] == {"count": vertices * steps, "unit": "vertex-step"}
    assert report["memory"]["estimated"] == scene.memory()
    assert report["command"] == f"landscape {' '.join(command)} --json"
    assert set(report["start"]) == {"warp", "taichi"}
    ours, theirs = report["rates"]
    for way in ("forward", "with_gradient"):
        ratio = ours[way]["episodes_per_second"] / theirs[way]["episodes_per_second"]
        assert ours[f"ratio_{way}"] == pytest.approx(ratio)
        assert {row["name"] for row in report["kernels"][way]["kernels"]} >= {"spring_kernels.pull"}
    assert 0 < report["sampler"]["share"] < 1


def test_bench_prints_tables(run: Callable[..., Said], tmp_path: Path) -> None:
    done = run("bench", "bounce", "--batch", "4", "--batch", "2", "--seconds", "0", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    batches = [line.split()[1] for line in done.stdout.splitlines() if " warp " in line and line[2].isdigit()]
    assert batches == ["2", "4"]
    steps = round(2 / gradscape.make("bounce", device="cpu").fidelity.dt)
    for shown in (f"{steps} body-steps", "episodes/s", "advance backward", "outside kernels", "the sampler's own"):
        assert shown in done.stdout
    assert not list(tmp_path.iterdir())


@needs_taichi
def test_a_slice_of_one_engine_is_not_continued_by_another(run: Callable[..., Said], tmp_path: Path) -> None:
    command = ["slice", "swing-velocity", "--dims", "0", "1", "--resolution", "2"]
    first, second = (
        json.loads(run(*command, "--engine", engine, "--json", cwd=tmp_path).stdout) for engine in ("warp", "taichi")
    )
    assert first["folder"] != second["folder"]
    assert second["episodes"] == 4
    refused = run(*command, "--engine", "taichi", "--out", first["folder"], cwd=tmp_path)
    assert refused.returncode == 2
    assert "engine: wanted 'taichi', found 'warp'" in refused.stderr


SIDE = 16
LONG = ["slice", "bounce", "--dims", "0", "1", "--resolution", str(SIDE), "--fidelity", "standard"]
LONG += ["--json", "--out", "cut"]
cut = partial(landscape, *LONG)


def test_sigkill_costs_nothing_but_the_tiles_under_way(run: Callable[..., Said], tmp_path: Path) -> None:
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    whole = run(*LONG, cwd=tmp_path / "whole")
    assert whole.returncode == 0, whole.stderr
    for instant in (Instant(1), Instant(5, "status/c"), Instant(7, "grad/c")):
        killed = alone(cut, tmp_path / "killed", instant)
        assert killed.returncode == -signal.SIGKILL
    resumed = json.loads(run(*LONG, cwd=tmp_path / "killed").stdout)
    assert 0 < resumed["resumed"] < SIDE**2
    assert resumed["episodes"] + resumed["resumed"] == SIDE**2
    one, two = (gradscape.open_slice(tmp_path / name / "cut/slice.zarr").data for name in ("whole", "killed"))
    for name in ("loss", "grad", "status"):
        np.testing.assert_array_equal(one[name], two[name])


def test_interrupt_ends_cleanly_and_says_how_to_go_on(run: Callable[..., Said], tmp_path: Path) -> None:
    done = alone(cut, tmp_path, Instant(9, "status/c", signal.SIGINT))
    assert done.returncode == 130
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert "the same command continues from there: landscape slice bounce" in done.stderr
    assert 0 < json.loads(run(*LONG, cwd=tmp_path).stdout)["resumed"] < SIDE**2
