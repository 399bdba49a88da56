"""What tests of the command share: what it makes, what it printed and what it imports."""

import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest
from benchmarks.results import leave_blank

from gradscape.cli import main

needs_taichi = pytest.mark.skipif(find_spec("taichi") is None, reason="Taichi has no wheels past Python 3.12")
NO_BROWSER = "there is no Chromium here: `apt-get install -y chromium` (or your system's) lets them run"
PATIENCE = 600_000  # milliseconds until a browser is given up, and no measure of anything


@dataclass(frozen=True)
class Said:
    returncode: int
    stdout: str
    stderr: str


def make(folder: Path, *commands: str) -> Path:
    """Run commands in this process and in a folder, their pictures blank: for tests of a module, which copy it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        leave_blank(patch.setattr)
        for command in commands:
            patch.setattr(sys, "argv", ["landscape", *command.split()])
            with pytest.raises(SystemExit) as left:
                main(command.split())
            assert not left.value.code, command
    return folder


def modules(*commands: list[str], missing: tuple[str, ...] = ()) -> set[str]:
    """Return what commands import, one after the other in a process where some packages are missing."""
    code = (
        f"import sys\nsys.modules.update(dict.fromkeys({missing}))\nfrom gradscape.cli import main\n"
        f"for words in {commands}:\n    try: main(words)\n    except SystemExit as left: assert not left.code, words\n"
        "print('MODULES', *(name for name in sys.modules if sys.modules[name]), file=sys.stderr)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(said.stderr.split("MODULES")[1].split())
