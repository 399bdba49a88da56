"""What tests of the command share: what it printed and what it imports."""

import subprocess
import sys
from dataclasses import dataclass

NO_BROWSER = "there is no Chromium here: `apt-get install -y chromium` (or your system's) lets them run"


@dataclass(frozen=True)
class Said:
    returncode: int
    stdout: str
    stderr: str


def modules(arguments: list[str]) -> set[str]:
    """Return what the command imports."""
    code = (
        "import sys\nfrom gradscape.cli import main\n"
        f"try: main({arguments})\nexcept SystemExit: pass\nprint('MODULES', *sys.modules, file=sys.stderr)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(said.stderr.split("MODULES")[1].split())
