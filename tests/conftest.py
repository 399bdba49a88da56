"""What tests of the command share."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gradscape.cli import main

from .command import Said


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
