"""What `benchmarks.same_bits` compares: one bit that differs anywhere is named; what is measured in seconds is not."""

import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from benchmarks import seeded, stored


def made(folder: Path, loss: float, seconds: float = 1.0, lowest: float = 0.5) -> dict[str, stored.Value]:
    group = zarr.create_group(folder / "run.zarr")
    for name, values in {"loss": [1.0, loss, np.nan], "seconds": [seconds, 2.0, 3.0]}.items():
        group.create_array(name, data=np.array(values))
    (folder / "summary.json").write_text(json.dumps({"loss": {"lowest": lowest}, "seconds": seconds}))
    return stored.contents(folder)


@pytest.mark.parametrize(
    ("other", "names"),
    [
        ({"loss": 2.0, "seconds": 9.0}, []),
        ({"loss": float(np.nextafter(2.0, 3.0))}, ["run.zarr loss"]),
        ({"loss": 2.0, "lowest": float(np.nextafter(0.5, 1.0))}, ["summary.json loss.lowest"]),
    ],
)
def test_one_bit_is_seen(tmp_path, other, names):
    found = stored.differences(made(tmp_path / "old", 2.0), made(tmp_path / "new", **other))
    assert [line.partition(":")[0] for line in found] == names


def test_zero_has_a_sign(tmp_path):
    assert stored.differences(made(tmp_path / "old", 0.0), made(tmp_path / "new", -0.0))


@pytest.mark.parametrize("seed", range(3))
def test_a_seed_has_its_command_lines(seed):
    first = seeded.commands(100, seed)
    assert first == seeded.commands(100, seed) != seeded.commands(100, seed + 1)
    assert len({command.name for command in first}) == 100
    done: set[str] = set()
    for command in first:
        assert done.issuperset(command.needs)
        done.add(command.name)
