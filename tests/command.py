"""What tests of the command share: what it printed, what it imports, pictures that it leaves blank."""

import math
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import pytest
from matplotlib.figure import Figure

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


def leave_blank(patch: pytest.MonkeyPatch) -> None:
    """Let pictures and frames of films be blank, and not laid out: most of what a small job takes is drawing them."""
    save = Figure.savefig

    def leave(figure: Figure, where: Any, **how: Any) -> None:
        if how.get("format") == "rgba":  # a frame, whose size is known
            where.write(bytes(4 * math.prod(figure.canvas.get_width_height())))
        else:
            save(Figure(figsize=(0.1, 0.1)), where, **how)

    patch.setattr(Figure, "savefig", leave)
    patch.setattr("gradscape.landscapes.draw.page.settle", lambda picture: picture.set_layout_engine("none"))
