"""The command line: what it prints, leaves, refuses and survives."""

import json
from pathlib import Path

import pytest

import gradscape
from gradscape.envs.bounce import Bounce

from .command import Run, needs_taichi


@pytest.mark.parametrize("arguments", [[], ["gallery"]])
def test_a_command_alone_is_its_help(run: Run, arguments: list[str]) -> None:
    alone = run(*arguments)
    assert (alone.returncode, alone.stderr) == (0, "")
    assert alone.stdout == run(*arguments, "--help").stdout
    assert alone.stdout.startswith(" ".join(["Usage: landscape", *arguments, "COMMAND"]))
    assert len(alone.stdout.splitlines()) > 8


def test_a_word_too_few_or_too_many_says_where_to_read_on(run: Run) -> None:
    for arguments in (["slice"], ["slice", "fluid", "--dimz", "0"], ["slice", "fluid", "--resolution", "x"]):
        assert "(see `landscape slice --help`)" in run(*arguments).stderr
    assert "(see `landscape --help`)" in run("plot").stderr


@pytest.mark.drawn
def test_slice_leaves_store_picture_and_summary(run: Run, tmp_path: Path) -> None:
    done = run.ok("slice branin --dims x0 1 --resolution 9 --json --out cut")
    summary = done.json
    assert summary == {**json.loads((tmp_path / "cut/summary.json").read_text()), "folder": "cut"}
    assert summary["env"] == "branin"
    assert summary["dims"] == ["x0", "x1"]
    assert summary["episodes"] == summary["status"]["ok"] == 81
    dataset = gradscape.open_slice(tmp_path / "cut/slice.zarr").data
    assert dataset["grad"].shape == (9, 9, 2)
    assert summary["loss"]["lowest"] == float(dataset["loss"].min())
    assert (tmp_path / "cut/landscape.png").read_bytes().startswith(b"\x89PNG")
    assert "81 episodes with gradients to compute: about" in done.stderr


def test_slice_says_where_the_gradient_is_exactly_zero(run: Run, tmp_path: Path) -> None:
    done = run.ok("slice pinball-2 --dims 0 1 --resolution 9 --json --out cut")
    dataset = gradscape.open_slice(tmp_path / "cut/slice.zarr").data
    flat = int((dataset["grad"] == 0).all("dim").sum())
    assert done.json["flat"] == flat
    assert 0 < flat < 81
    assert f"gradient exactly zero at {flat / 81:.1%} of points" in done.stderr


@pytest.mark.parametrize("verb", [("slice",), ("study", "convergence"), ("check",)])
def test_a_device_without_memory_for_a_point_is_one_line_and_exit_code_1(
    run: Run, monkeypatch: pytest.MonkeyPatch, verb: tuple[str, ...]
) -> None:
    def full(*_: object, **__: object) -> None:
        raise RuntimeError("Failed to allocate 18792000 bytes on device 'cuda:0'")

    monkeypatch.setattr(Bounce, "_evaluate", full)
    dims = ["--dims", "0", "1", "--resolution", "4"] if verb == ("slice",) else []
    done = run(*verb, "bounce", *dims)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith("landscape: ")
    assert "out of memory" in last
    assert "Failed to allocate 18792000 bytes" in last
    assert last.endswith("use a lower --fidelity or another --device")


@pytest.mark.parametrize(("name", "text"), [("p.json", "[1.5, 2.5]"), ("p.txt", "1.5 2.5\n"), ("p.csv", "1.5,2.5\n")])
def test_a_slice_goes_through_the_point_in_a_file(run: Run, tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    arguments = ["--through", name, "--window", "0.1", "--resolution", "3", "--out", "cut", "--no-gradients"]
    run.ok("slice", "branin", "--dims", "0", "1", *arguments)
    dataset = gradscape.open_slice(tmp_path / "cut/slice.zarr").data
    assert "grad" not in dataset
    assert (float(dataset["u"][1]), float(dataset["v"][1])) == (1.5, 2.5)


@pytest.mark.drawn
def test_bounce_counts_the_bounces_it_marks(run: Run, tmp_path: Path) -> None:
    summary = run.json("bounce --axis y --resolution 64 --out b")
    assert summary["dims"] == ["velocity y"]
    assert summary["status"]["ok"] == 64
    assert (tmp_path / "b/landscape.png").exists()


@pytest.mark.slow
@needs_taichi
def test_bench_prints_rates_ratios_and_memory_as_json(run: Run) -> None:
    command = ["bench", "swing-velocity", "--second-engine", "taichi", "--batch", "2", "--seconds", "0"]
    report = run.json(*command)
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
        assert {row["name"] for row in report["kernels"][way]["kernels"]} >= {"rows.pull"}
    assert 0 < report["sampler"]["share"] < 1


def test_bench_prints_tables(run: Run, tmp_path: Path) -> None:
    done = run.ok("bench bounce --batch 4 --batch 2 --seconds 0")
    batches = [line.split()[1] for line in done.stdout.splitlines() if " warp " in line and line[2].isdigit()]
    assert batches == ["2", "4"]
    steps = round(2 / gradscape.make("bounce", device="cpu").fidelity.dt)
    for shown in (f"{steps} body-steps", "episodes/s", "advance backward", "outside kernels", "the sampler itself"):
        assert shown in done.stdout
    assert not list(tmp_path.iterdir())


@needs_taichi
def test_a_slice_of_one_engine_is_not_continued_by_another(run: Run) -> None:
    command = ["slice", "swing-velocity", "--dims", "0", "1", "--resolution", "2"]
    first, second = (run.json(*command, "--engine", engine) for engine in ("warp", "taichi"))
    assert first["folder"] != second["folder"]
    assert second["episodes"] == 4
    run.refuse(*command, "--engine", "taichi", "--out", first["folder"], said="engine: wanted 'taichi', found 'warp'")
