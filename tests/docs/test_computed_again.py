"""README's two tables, computed from the published files by the programs that two pages print."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from docs.pages.tables import ROOT

from gradscape.landscapes.storage.records import read_json, write_record

pytestmark = pytest.mark.docs
PROGRAM = re.compile(r"^## Compute it again\n.*?^```python\n(.*?)^```\n", re.DOTALL | re.MULTILINE)


def computed(page: str, folder: Path) -> list[str]:
    """Return what a page's program prints in a folder, isolated: it cannot import the package from this checkout."""
    (program,) = PROGRAM.findall((ROOT / "docs" / page).read_text())
    assert "gradscape" not in program
    done = subprocess.run([sys.executable, "-I", "-c", program], cwd=folder, capture_output=True, text=True, check=True)
    assert not done.stderr
    return done.stdout.splitlines()


def published(name: str) -> list[str]:
    """Return the rows of README's table of a name."""
    (table,) = re.findall(rf"^<!-- {name} -->\n(.*?)^<!-- /{name} -->", (ROOT / "README.md").read_text(), re.S | re.M)
    return [line for line in table.splitlines() if line.startswith("| `")]


def test_the_league_follows_from_the_published_files_alone(tmp_path: Path) -> None:
    rows = published("league")
    assert len(rows) == 16
    assert computed("races.md", ROOT) == rows
    kept = shutil.copytree(ROOT / "gallery/data/league", tmp_path / "gallery/data/league")
    with np.load(kept / "torus.npz") as found:
        arrays = dict(found)
    arrays["loss"] = np.where(np.repeat(arrays["method"], arrays["count"]) == "turbo", 0.0, arrays["loss"])
    np.savez(kept / "torus.npz", **arrays)
    differ = [ours for ours, theirs in zip(computed("races.md", tmp_path), rows, strict=True) if ours != theirs]
    assert [row.split(" | ")[:3] for row in differ] == [["| `torus`", "draft", "**`turbo` 1.00, first**"]]


def test_the_censuses_follow_from_the_published_files_alone(tmp_path: Path) -> None:
    rows = [row.rsplit(" | ", 1)[0] + " |" for row in published("censuses") if "not measured" not in row]
    assert len(rows) > 3
    assert computed("measured.md", ROOT) == rows
    kept = shutil.copytree(ROOT / "gallery/data/census", tmp_path / "gallery/data/census")
    record = read_json(kept / "cartpole-cpu.json")
    for one in record["slices"][:32]:
        one["words"] = ["flat"]
    write_record(kept / "cartpole-cpu.json", record)
    differ = [ours for ours, theirs in zip(computed("measured.md", tmp_path), rows, strict=True) if ours != theirs]
    assert [row.split(" | ")[0] for row in differ] == ["| `cartpole`"]
