"""What tests of the command share."""

import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gradscape.cli import main

from .command import Said

# A shell that is not interactive starts what it sends to the background deaf to Ctrl-C; commands that tests interrupt
# would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Said]:
    """Run the command in this process, in a folder of its own, on a wide screen."""

    def command(*arguments: str, cwd: Path) -> Said:
        monkeypatch.chdir(cwd)
        monkeypatch.setattr(sys, "argv", ["landscape", *arguments])
        monkeypatch.setenv("COLUMNS", "160")
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main(list(arguments))
        return Said(int(left.value.code or 0), *capsys.readouterr())

    return command
