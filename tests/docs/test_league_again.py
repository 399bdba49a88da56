"""README's table of the league, computed from the published files by the program that the page on races prints."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from docs.pages.tables import ROOT

pytestmark = pytest.mark.docs
PROGRAM = re.compile(r"^## Compute it again\n.*?^```python\n(.*?)^```\n", re.DOTALL | re.MULTILINE)
TABLE = re.compile(r"^<!-- league -->\n(.*?)^<!-- /league -->", re.DOTALL | re.MULTILINE)


def computed(folder: Path) -> list[str]:
    """Return what the program prints in a folder, isolated: where it cannot import the package from this checkout."""
    (program,) = PROGRAM.findall((ROOT / "docs/races.md").read_text())
    assert "gradscape" not in program
    done = subprocess.run([sys.executable, "-I", "-c", program], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_the_league_follows_from_the_published_files_alone(tmp_path: Path) -> None:
    (table,) = TABLE.findall((ROOT / "README.md").read_text())
    published = [line for line in table.splitlines() if line.startswith("| `")]
    assert len(published) == 16
    assert computed(ROOT) == published
    kept = shutil.copytree(ROOT / "gallery/data/league", tmp_path / "gallery/data/league")
    with np.load(kept / "torus.npz") as found:
        arrays = dict(found)
    arrays["loss"] = np.where(np.repeat(arrays["method"], arrays["count"]) == "turbo", 0.0, arrays["loss"])
    np.savez(kept / "torus.npz", **arrays)
    differ = [ours for ours, theirs in zip(computed(tmp_path), published, strict=True) if ours != theirs]
    assert [row.split(" | ")[:3] for row in differ] == [["| `torus`", "draft", "**`turbo` 1.00, first**"]]
