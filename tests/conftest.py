"""What tests of the command share."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from gradscape.cli import main

from .command import Said

# A shell that is not interactive starts what it sends to the background deaf to Ctrl-C; commands that tests interrupt
# would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Said]:
    """Run the command in this process, in a folder of its own, on a wide screen unless another width is given."""

    def command(*arguments: str, cwd: Path, width: int = 160) -> Said:
        monkeypatch.chdir(cwd)
        monkeypatch.setattr(sys, "argv", ["landscape", *arguments])
        monkeypatch.setenv("COLUMNS", str(width))
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main(list(arguments))
        return Said(int(left.value.code or 0), *capsys.readouterr())

    return command


@pytest.fixture
def rerun() -> Callable[..., int]:
    """Run rerun's own program, which asks nobody outside, and return its exit code."""
    from gradscape.landscapes.draw import viewer

    spec = find_spec("rerun_cli")
    assert spec is not None
    program = Path(next(iter(spec.submodule_search_locations or ()))) / "rerun"

    def command(*arguments: str) -> int:
        done = subprocess.run([program, *arguments], env=os.environ | viewer.SILENT, capture_output=True, timeout=60)
        return done.returncode

    return command
