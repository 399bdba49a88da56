"""Jobs of all kinds that are killed at random moments end in the bits of undisturbed ones."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "kills.py"


@pytest.mark.skipif(sys.platform == "win32", reason="jobs are forked")
def test_five_kills_change_no_bit(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "--count", "5", "--seed", "1", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert sum(sum(one["kills"].values()) for one in found.values()) == 5
    assert all(one["jobs"] and not one["other_bits"] for one in found.values())
    assert len(found) >= 3
    assert not list(tmp_path.iterdir())
