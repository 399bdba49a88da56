"""What tests of the command share."""

import gc
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from gradscape.cli import main
from gradscape.envs import registry

from .command import NO_BROWSER, PATIENCE, Run, Said, leave_blank

# A shell that is not interactive starts what it sends to the background deaf to Ctrl-C; commands that tests interrupt
# would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A scene spreads a batch over a thread for each core. Two workers that do so on two cores take turns four abreast, and
# need half as long again; each gets a core of its own. One alone goes where there is room.
alone = os.environ.get("PYTEST_XDIST_WORKER_COUNT") == "1"
if (worker := os.environ.get("PYTEST_XDIST_WORKER")) and not alone and hasattr(os, "sched_setaffinity"):
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[int(worker.removeprefix("gw")) % len(cores)]})

MANY = 20_000  # objects

# Hypothesis gives an example 200 ms, and complains of those that take long to make.
settings.register_profile("timeless", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("timeless")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what needs a browser."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker("browser")


@pytest.fixture(scope="session", autouse=True)
def frozen() -> Iterator[None]:
    """Let what is frozen stay so: a study of fidelities thaws it at its end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gc, "unfreeze", lambda: None)
        yield


@pytest.fixture(autouse=True)
def freeze(frozen: None) -> None:
    """Spare what earlier tests have loaded to every collection of garbage: studies ask for one at each step.

    A process that has loaded all engines holds millions of objects, and one look through them takes a second.
    """
    if len(gc.get_objects(generation=2)) > MANY:
        gc.collect()
        gc.freeze()


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    """Forget the environments that a test registers, or a command that it runs in this process."""
    known, path = dict(registry.entries()), list(sys.path)
    yield
    registry.entries().clear()
    registry.entries().update(known)
    sys.path[:] = path


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish() -> Generator[None]:
    """Let Taichi keep what it has compiled: it does as its program is taken down, which a frozen one never is."""
    yield
    if taichi := sys.modules.get("taichi"):
        taichi.reset()


@pytest.fixture(autouse=True)
def blank(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave pictures blank, but in tests marked `drawn`: what a test does draws more of them than it looks at."""
    if request.node.get_closest_marker("drawn") is None:
        leave_blank(monkeypatch.setattr)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Run the command in this process, in a folder of its own, on a wide screen unless another width is given.

    What a job takes is foretold by one episode or two and no more.
    """
    for name in ("MOMENT", "ENOUGH", "WARM_UP"):
        monkeypatch.setattr(f"gradscape.landscapes.cost.{name}", 0.0)
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str, cwd: Path | None, width: int) -> Said:
        monkeypatch.chdir(cwd or tmp_path)
        monkeypatch.setattr(sys, "argv", ["landscape", *arguments])
        monkeypatch.setenv("COLUMNS", str(width))
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main(list(arguments))
        return Said(int(left.value.code or 0), *capsys.readouterr())

    return Run(command)


@pytest.fixture
def rerun() -> Callable[..., int]:
    """Run rerun's own program, which asks nobody outside, and return its exit code."""
    from gradscape.landscapes.draw.recordings import viewer

    spec = find_spec("rerun_cli")
    assert spec is not None
    program = Path(next(iter(spec.submodule_search_locations or ()))) / "rerun"

    def command(*arguments: str) -> int:
        done = subprocess.run([program, *arguments], env=os.environ | viewer.SILENT, capture_output=True)
        return done.returncode

    return command


@pytest.fixture(scope="session")
def browser():  # type: ignore[no-untyped-def]
    """Start the system's Chromium, one for all tests of a worker: its driver leaves no room for a second."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if not program:
        pytest.skip(NO_BROWSER)
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=PATIENCE)
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=program, args=["--disable-gpu"], timeout=PATIENCE)
        yield opened
        opened.close()
