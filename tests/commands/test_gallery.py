"""`landscape gallery`: what is computed and when, what is there, building and serving the site."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from signal import SIGINT
from urllib.request import urlopen

import numpy as np
import pytest

from gradscape.cli import main
from gradscape.envs.functions import Branin, Function
from gradscape.gallery import parts as gallery_parts
from gradscape.gallery.figures import Figure
from gradscape.gallery.paper import PaperCaption
from gradscape.jobs.slice import SliceCost, SliceJob
from gradscape.landscapes.identity import stored_identity
from gradscape.landscapes.measures.undersampled import probes
from gradscape.landscapes.storage.store import open_slice
from gradscape.landscapes.verification import POINTS

from ..command import leave_blank

pytestmark = pytest.mark.e2e

AIM = Figure("bounce-y", "bounce", (1,), PaperCaption("It jumps.", 8), "example:aim", resolution=12, fidelity="draft")
BRANIN = PaperCaption("Three minima <b>&</b> no network.")
FIGURES = [
    AIM,
    replace(AIM, id="bounce-x-y", dims=(0, 1), caption=PaperCaption("A plane of it.")),
    Figure("branin", "branin", (0, 1), BRANIN, resolution=12, fidelity="exact", over=""),
]
READ_FIGURES = "gradscape.gallery.figures.read_figures"


def gallery(*arguments: str) -> int:
    with pytest.raises(SystemExit) as left:
        main(["gallery", *arguments])
    return int(left.value.code or 0)


def compute(data: Path, *arguments: str) -> int:
    return gallery("compute", "--part", "slices", "--device", "cpu", "--data", str(data), *arguments)


@pytest.fixture(scope="module")
def listed() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(READ_FIGURES, lambda: list(FIGURES))
        leave_blank(patch.setattr)
        yield


@pytest.fixture(scope="module")
def data(listed: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compute a small gallery."""
    folder = tmp_path_factory.mktemp("data")
    assert compute(folder) == 0
    return folder


def test_compute_goes_on_where_it_stopped_and_computes_nothing_twice(
    listed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points: list[int] = []
    evaluate = Branin._evaluate

    def stopping(env: Branin, x, *, grad):  # type: ignore[no-untyped-def]
        if sum(points) >= 64:
            raise KeyboardInterrupt
        points.append(len(x))
        return evaluate(env, x, grad=grad)

    monkeypatch.setattr(SliceJob, "cost", lambda _: SliceCost(1, 0.5, 0))  # that evaluates the first points too
    monkeypatch.setattr(Branin, "_evaluate", stopping)
    command = ("--only", "branin", "--resolution", "40")
    assert compute(tmp_path, *command) == 130
    said = capsys.readouterr().err
    assert "about 13 min in all" in said
    assert re.search(r"stopped: in branin, \d+ of 1600 points are kept in .*; the same command continues", said)
    kept = int((open_slice(tmp_path / "branin/slice.zarr")["status"] > 0).sum())
    assert 0 < kept <= sum(points)
    points.clear()
    monkeypatch.setattr(
        Branin, "_evaluate", lambda env, x, *, grad: points.append(len(x)) or evaluate(env, x, grad=grad)
    )
    assert compute(tmp_path, *command) == 0
    assert points.pop(0) == POINTS  # which are verified
    assert 0 < sum(points) - (1600 - kept) <= probes(1600, grad=True)  # which look between the samples
    points.clear()
    assert compute(tmp_path, *command) == 0
    assert not points
    assert "slices: 1 of 1 are done already" in capsys.readouterr().err


def test_a_figure_that_fails_does_not_stop_the_others(
    listed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = replace(FIGURES[1], id="broken", through="example:none")
    monkeypatch.setattr(READ_FIGURES, lambda: [broken, FIGURES[2]])
    assert compute(tmp_path) == 1
    said = capsys.readouterr().err
    assert "broken failed: ValueError" in said
    assert "1 of 2 figures failed: broken" in said
    assert np.isfinite(open_slice(tmp_path / "branin/slice.zarr")["loss"]).all()


def test_list_says_what_is_there_missing_and_other(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert gallery("list", "--data", str(data), "--json") == 0
    assert {one["id"]: (one["done"], one["points"]) for one in json.loads(capsys.readouterr().out)} == {
        "bounce-y": (12, 12), "bounce-x-y": (144, 144), "branin": (144, 144)
    }  # fmt: skip
    gallery("list", "--data", str(data / "none"), "--json")
    assert {one["done"] for one in json.loads(capsys.readouterr().out)} == {0}
    assert gallery_parts.SlicePart(replace(FIGURES[2], resolution=6), data, "cpu").state().done is None


def test_a_slice_of_other_settings_than_now_is_said_to_be_so(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    coarser = {name: replace(one, resolution=one.resolution + 7) for name, one in Branin.fidelities.items()}
    monkeypatch.setattr(Branin, "fidelities", coarser)
    capsys.readouterr()
    assert gallery("list", "--data", str(data), "--json") == 0
    changed = {one["id"]: one["changed"] for one in json.loads(capsys.readouterr().out)}
    assert changed == {"bounce-y": "", "bounce-x-y": "", "branin": "resolution"}
    assert gallery("list", "--data", str(data)) == 0
    assert "1 out of date: the settings of their fidelity have changed" in capsys.readouterr().out
    assert gallery("build", "--data", str(data), "--out", str(tmp_path / "site")) == 0
    pages = {name: (tmp_path / "site" / name / "index.html").read_text() for name in ("bounce-y", "branin")}
    assert "resolution was 0 and is now 7. A new sample may look different." in pages["branin"]
    assert "Made with an earlier version" not in pages["bounce-y"]


def test_build_refuses_an_empty_folder_of_data_and_foreign_files(listed: None, data: Path, tmp_path: Path) -> None:
    assert gallery("build", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "site")) == 2
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("words")
    assert gallery("build", "--data", str(data), "--out", str(tmp_path / "mine")) == 2
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_a_figure_of_which_nothing_is_sampled_begins_anew_by_another_model(
    listed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Function, "model_version", 99)
    monkeypatch.setattr(SliceJob, "run", stop)
    assert compute(tmp_path, "--only", "branin") == 1
    assert stored_identity(open_slice(tmp_path / "branin/slice.zarr"))["model_version"] == 99
    monkeypatch.undo()
    monkeypatch.setattr(READ_FIGURES, lambda: list(FIGURES))
    assert compute(tmp_path, "--only", "branin") == 0
    assert stored_identity(open_slice(tmp_path / "branin/slice.zarr"))["model_version"] == Function.model_version


def stop(*_: object) -> None:
    raise RuntimeError("stopped")


def asked(address: str, path: str, **headers: str) -> tuple[int, bytes]:
    """Ask a server for a path as it stands, with no header but those given."""
    connection = HTTPConnection(address.removeprefix("http://").rstrip("/"))
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    with closing(connection), connection.getresponse() as answer:
        return answer.status, answer.read()


@pytest.fixture(scope="module")
def site(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a site, and plant links in it: of a file and of a page out of it, within it, in a loop."""
    folder = tmp_path_factory.mktemp("served")
    site, secret = folder / "site", folder / "secret"
    assert gallery("build", "--data", str(data), "--out", str(site)) == 0
    secret.mkdir()
    (secret / "index.html").write_text("secret")
    (site / "planted").mkdir()
    (site / "planted/index.html").symlink_to(secret / "index.html")
    (site / "file.html").symlink_to(secret / "index.html")
    (site / "folder").symlink_to(secret)
    (site / "inside.html").symlink_to("branin/index.html")
    (site / "loop").symlink_to("loop")
    return site


@pytest.fixture(scope="module")
def served(site: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "gradscape", "gallery", "serve", "--out", str(site), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
            assert found
            yield found[0]
            process.send_signal(SIGINT)
            assert process.communicate() == ("", "")
            assert process.returncode == 0
        finally:
            process.kill()


def test_serve_serves_what_build_built(served: str) -> None:
    with urlopen(served + "branin/index.html") as answer:
        assert b"Three minima &lt;b&gt;" in answer.read()
    assert asked(served, "/inside.html", Host="localhost")[0] == 200


def test_serve_answers_under_names_of_this_machine_alone(served: str) -> None:
    """A page elsewhere whose name is made to mean 127.0.0.1 reads what is answered to that name."""
    for name in ("127.0.0.1", "localhost:1", "LocalHost", "[::1]:80"):  # a tunnel's port is another
        assert asked(served, "/", Host=name)[0] == 200
    for name in ("evil.example", "127.0.0.1.evil.example", "localhost@evil.example", "evil.example:127", "0.0.0.0", ""):
        assert asked(served, "/", Host=name)[0] == 421
    assert asked(served, "/")[0] == 421


def test_serve_serves_no_more_than_the_sites_files(served: str, site: Path) -> None:
    folders = [f"/{one.relative_to(site)}/" for one in site.rglob("*") if one.is_dir() and not one.is_symlink()]
    unlisted = [one for one in folders if not (site / one[1:] / "index.html").is_file()]
    assert "/static/" in unlisted
    outside = ["/file.html", "/planted/", "/planted/index.html", "/folder/", "/folder/index.html"]
    none = ["/%00", "/static/%00", "/a%00b/", "/loop", "/loop/", f"/{'a' * 5000}", "/%ff", "/%ed%a0%80", "http://[/.."]
    for path in [*unlisted, *outside, *none]:
        status, said = asked(served, path, Host="localhost")
        assert (status, b"secret" in said) == (404, False), path


def test_a_device_that_is_not_here_is_refused_at_once(
    listed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("gradscape.envs.engines.runtime.cuda_available", lambda: False)
    capsys.readouterr()
    assert gallery("compute", "--device", "cuda", "--data", str(tmp_path / "data")) == 2
    said = capsys.readouterr().err
    assert said == ("landscape: --device cuda needs a CUDA device, and none was found; use --device cpu or auto\n")
    assert not list(tmp_path.iterdir())


def test_without_a_checkout_s_data_results_go_to_the_folder_where_one_stands(
    listed: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = tmp_path / "site-packages" / "data"
    (installed / "studies").mkdir(parents=True)
    monkeypatch.setattr("gradscape.gallery.files.DATA", installed)
    monkeypatch.chdir(tmp_path)
    how = ["--part", "slices", "--device", "cpu", "--only", "branin", "--resolution", "4"]
    assert gallery("compute", *how) == 0
    assert (tmp_path / "out/gallery-data/branin/slice.zarr.zip").exists()
    assert gallery("build") == 0
    assert (tmp_path / "out/gallery/branin/index.html").exists()
    assert sorted(path.name for path in installed.rglob("*")) == ["studies"]
