"""Jobs of all kinds that are killed at random moments end in the bits of undisturbed ones."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from gradscape.cli import main

BOUNCE = ["bounce", "--dims", "0", "1", "--resolution", "4", "--fidelity", "draft"]
SEARCH = ["--budget", "4", "--fidelity", "draft"]
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


@pytest.mark.parametrize(
    ("command", "left"),
    [
        (["slice", *BOUNCE], ".slice.zarr.0a.making"),
        (["sweep", *BOUNCE, "--over", "2", "--frames", "2"], "frames/.0.zarr.0a.making"),
        (["optimize", "bounce", "--method", "random", *SEARCH], ".run.zarr.0a.making"),
        (["race", "bounce", "--methods", "random", "--seeds", "2", *SEARCH], "random-0/.run.zarr.0a.making"),
        (["tradeoff", "bounce", "--points", "2", "--ladder", "engine"], ".settings.json.0a.partial"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else None,
)
def test_what_a_kill_left_in_a_folder_is_no_other_file(
    command: list[str], left: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "made" / left).mkdir(parents=True)
    (tmp_path / "made" / left / "zarr.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gradscape.tolerance.user_data_path", lambda name: tmp_path / "data" / name)
    for name in ("TIMING", "PATIENCE"):
        monkeypatch.setattr(f"gradscape.landscapes.tradeoff.{name}", 0.002)
    with pytest.raises(SystemExit) as ended:
        main([*command, "--device", "cpu", "--out", "made"])
    assert not ended.value.code
