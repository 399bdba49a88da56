"""`landscape view`: what it opens, serves and refuses; and `overlay --spawn`, which opens what it has drawn."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gradscape.api import view
from gradscape.landscapes.draw.recordings import viewer

from ..command import Run


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of what verbs leave, as far as `view` looks at it, on a machine without a display."""
    for name in view.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    files = ("cut/landscape.png", "cut/slice.zarr.zip", "run/progress.png", "empty/a.txt")
    for file in (*files, "site/index.html", "my site/index.html"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text("")
    (tmp_path / "some.rrd").write_bytes(b"RRF2")
    return tmp_path


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("view nothing.png", "view found no file or folder nothing.png"),
        ("view empty/a.txt", "view opens .png, .html, .mp4, .gif, .rrd and results folders"),
        ("view cut/landscape.png", "this machine has no display to open cut/landscape.png"),
        ("view cut/slice.zarr.zip", "this machine has no display to open cut/landscape.png"),
        ("view run", "this machine has no display to open run/progress.png"),
        ("view empty", "empty contains none of index.html, overlay.rrd, race.png"),
        ("view cut --serve", "--serve shows only recordings (.rrd)"),
        ("view site --serve", "view does not serve a site; serve it with: landscape gallery serve --out site"),
        ("view site", "serve it to a browser with: landscape gallery serve --out site"),
    ],
)
@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
def test_what_cannot_be_shown_is_refused_in_one_line(run: Run, desk: Path, command: str, said: str) -> None:
    done = run(command)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert said in done.stderr


@pytest.mark.parametrize(("command", "opened"), [("view cut", "cut/landscape.png"), ("view site", "site/index.html")])
def test_a_picture_opens_in_the_systems_own_program(
    run: Run, desk: Path, monkeypatch: pytest.MonkeyPatch, command: str, opened: str
) -> None:
    monkeypatch.setenv("DISPLAY", ":1")
    launched: list[str] = []
    monkeypatch.setattr("gradscape.api.view.launch", lambda path: launched.append(str(path)) or True)
    run.ok(command)
    assert launched == [str((desk / opened).resolve())]
    monkeypatch.setattr("gradscape.api.view.launch", lambda path: False)
    refused = run(command)
    assert (refused.returncode, "this system has no program that opens" in refused.stderr) == (1, True)


def test_a_recording_needs_a_display_or_is_served_until_it_is_stopped(
    run: Run, desk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if sys.platform == "linux":
        said = run("view some.rrd").stderr
        assert "open it in a browser with: landscape view some.rrd --serve" in said
    served: list[str] = []

    @contextmanager
    def serve(path: Path) -> Iterator[str]:
        served.append(path.name)
        yield "http://127.0.0.1:1/?url=..."

    def stopped(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer, "serve_recording", serve)
    monkeypatch.setattr("time.sleep", stopped)
    done = run("view some.rrd --serve")
    assert (done.returncode, served) == (0, ["some.rrd"])
    assert "some.rrd is at http://127.0.0.1:1/?url=... until Ctrl-C" in done.stderr
