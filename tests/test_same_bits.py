"""`benchmarks.same_bits` names one bit that differs anywhere, and nothing that is measured in seconds."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import zarr
from benchmarks.same_bits import COMMANDS, Value, contents, differences


def made(folder: Path, loss: float, seconds: float = 1.0, lowest: float = 0.5) -> dict[str, Value]:
    group = zarr.create_group(folder / "run.zarr")
    for name, values in {"loss": [1.0, loss, np.nan], "seconds": [seconds, 2.0, 3.0]}.items():
        group.create_array(name, data=np.array(values))
    (folder / "summary.json").write_text(json.dumps({"loss": {"lowest": lowest}, "seconds": seconds}))
    return contents(folder)


@pytest.mark.parametrize(
    ("other", "names"),
    [
        ({"loss": 2.0, "seconds": 9.0}, []),
        ({"loss": float(np.nextafter(2.0, 3.0))}, ["run.zarr loss"]),
        ({"loss": 2.0, "lowest": float(np.nextafter(0.5, 1.0))}, ["summary.json loss.lowest"]),
    ],
)
def test_one_bit_is_seen(tmp_path, other, names):
    found = differences(made(tmp_path / "old", 2.0), made(tmp_path / "new", **other))
    assert [line.partition(":")[0] for line in found] == names


def test_zero_has_a_sign(tmp_path):
    assert differences(made(tmp_path / "old", 0.0), made(tmp_path / "new", -0.0))


def test_every_command_makes_a_folder_of_its_own_after_those_it_reads():
    names, done = [], set()
    for group in COMMANDS.read_text().strip().split("\n\n"):
        lines = [shlex.split(line) for line in group.splitlines()]
        for words in lines:
            read = [word.removeprefix("best:") for word in words[:-1]]
            assert done.issuperset(word for word in read if word.rpartition("-")[0] and word in {*names, *done})
        names += [words[-1] for words in lines]
        done |= {words[-1] for words in lines}
    assert len(names) == len(set(names)) > 100
