import fcntl
import io
import json
import os
import pickle
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr

from gradscape.landscapes.identity import StoreError
from gradscape.landscapes.objective import Evaluation, Status
from gradscape.landscapes.space import ParameterSpace
from gradscape.optim.base import Kind
from gradscape.optim.runs.store import CHUNK, STATE, Journal, RunStore, is_run

from ..clock import Clock

SPACE = ParameterSpace(("speed", "angle"), torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 3.0]), ("m/s", "rad"))
IDENTITY = {"objective": "hill", "fidelity": "draft", "method": "walk", "seed": 4}


def run_at(path: Path, *, budget: int = 100, **changes: object) -> RunStore:
    provenance = {"loss_unit": "m", "command": "landscape optimize"}
    return RunStore.open_or_create(path, SPACE, identity=IDENTITY | changes, provenance=provenance, budget=budget)


def points(count: int, *, grad: bool = True, start: int = 0) -> tuple[torch.Tensor, Evaluation]:
    """Points whose losses count up and whose third one fails."""
    x = torch.rand(count, 2, generator=torch.Generator().manual_seed(start), dtype=torch.float64)
    loss = torch.arange(start, start + count, dtype=torch.float64)
    failed = torch.where(loss == 2, Status.ESCAPED, Status.OK)
    return x, Evaluation.from_results(
        loss, torch.tensor([3.0, 4.0]).expand(count, 2).double() if grad else None, failed
    )


def test_a_run_keeps_what_the_first_episode_that_raised_said(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr")
    run.append(*points(2), Kind.RANDOM, 0.0)
    assert (run.error, run.read().errors) == ("", "")
    for said in ("RuntimeError: too much work", "another"):
        x, loss = torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
        raised = Evaluation.from_results(loss, None, torch.tensor([Status.OK, Status.ERROR]), said)
        run.append(x, raised, Kind.RANDOM, 0.0)
    run.save(lambda: {})
    again = RunStore.open(tmp_path / "run.zarr")
    assert again.failed == 2
    said = "2 points raised: first 'RuntimeError: too much work'"
    assert again.read().errors == said
    assert said in repr(again.read())
    assert xr.open_zarr(tmp_path / "run.zarr").attrs["error"] == "RuntimeError: too much work"


def test_a_run_reads_back_as_it_was_written(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr")
    run.set_gradient_cost(2.5)
    run.append(*points(4), Kind.DESCENT, 1.5)
    run.append(*points(2, grad=False, start=4), Kind.POPULATION, 0.5)
    run.save(lambda: {"at": "what\ncomes\nnext"})
    again = RunStore.open(tmp_path / "run.zarr")
    xr.testing.assert_identical(again.dataset(), run.dataset())
    assert (again.count, again.told, again.state()) == (6, 6, {"at": "what\ncomes\nnext"})
    table = again.dataset()
    np.testing.assert_array_equal(table["loss"], [0, 1, np.nan, 3, 4, 5])
    np.testing.assert_array_equal(table["slope"], [5, 5, np.nan, 5, np.nan, np.nan])
    np.testing.assert_array_equal(table["episodes"], [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(table["forwards"], [2.5, 5, 7.5, 10, 11, 12])
    np.testing.assert_array_equal(table["seconds"], [1.5] * 4 + [2.0] * 2)
    np.testing.assert_array_equal(table["x"][4:], points(2, start=4)[0])
    assert table["status"].values[2] == Status.ESCAPED
    assert table["kind"].values.tolist() == [Kind.DESCENT] * 4 + [Kind.POPULATION] * 2
    assert table["kind"].attrs["flag_meanings"].split()[Kind.POPULATION] == "population"
    assert again.failed == 1
    assert again.best_loss == 0.0


def test_plain_xarray_reads_the_table_with_its_units(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr")
    run.append(*points(5, grad=False), Kind.RANDOM, 1.0)
    run.save(lambda: {})
    table = xr.open_zarr(tmp_path / "run.zarr").load()
    there = table.isel(evaluation=table["status"] != Status.MISSING)
    assert table.sizes == {"evaluation": 100, "dim": 2}
    assert there.sizes["evaluation"] == 5
    for name, values in run.dataset().items():
        np.testing.assert_array_equal(there[name], values)
    assert list(there["dim"].values) == ["speed", "angle"]
    assert there["loss"].attrs["units"] == "m"
    about = {"env": "hill", "method": "walk", "seed": 4, "budget": 100, "fidelity": "draft", "loss_unit": "m"}
    assert there.attrs.items() >= (about | {"units": ["m/s", "rad"], "lower": [-1, 0], "upper": [1, 3]}).items()


def test_rows_that_the_state_does_not_count_do_not_exist(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr")
    run.append(*points(3), Kind.RANDOM, 1.0)
    run.save(lambda: {"at": "three"})
    state = (tmp_path / "run.zarr" / STATE).read_bytes()
    run.append(*points(3, start=3), Kind.RANDOM, 1.0)
    run.save(lambda: {"at": "six"})
    (tmp_path / "run.zarr" / STATE).write_bytes(state)  # as if killed between the rows and the state
    again = RunStore.open(tmp_path / "run.zarr")
    assert (again.count, again.state()) == (3, {"at": "three"})
    assert again.dataset().sizes["evaluation"] == 3


def test_a_proposal_cut_short_is_in_the_table_and_dropped_before_the_run_goes_on(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr", budget=5)
    run.append(*points(3), Kind.RANDOM, 1.0)
    run.save(lambda: {"at": "three"})
    run.append(*points(2, start=3), Kind.RANDOM, 1.0)
    run.save()
    again = RunStore.open(tmp_path / "run.zarr")
    assert (again.count, again.told, again.state()) == (5, 3, {"at": "three"})
    again.rewind()
    assert (again.count, len(again.dataset()["loss"])) == (3, 3)
    again.extend(8)
    again.append(*points(5, start=3), Kind.RANDOM, 1.0)
    again.save(lambda: {"at": "eight"})
    assert RunStore.open(tmp_path / "run.zarr").dataset()["loss"].values[-5:].tolist() == [3, 4, 5, 6, 7]
    assert xr.open_zarr(tmp_path / "run.zarr").sizes["evaluation"] == 8


def test_a_run_killed_while_it_writes_anew_what_was_cut_short_keeps_what_was_told(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr", budget=9)
    run.append(*points(3), Kind.RANDOM, 1.0)
    run.save(lambda: {"at": "three"})
    run.append(*points(6, start=3), Kind.RANDOM, 1.0)
    run.save()
    run.rewind()
    state = (tmp_path / "run.zarr" / STATE).read_bytes()
    run.append(*points(2, start=3), Kind.RANDOM, 2.0)
    run.save(lambda: {"at": "five"})
    (tmp_path / "run.zarr" / STATE).write_bytes(state)  # as if killed between the rows and the state
    again = RunStore.open(tmp_path / "run.zarr")
    assert (again.count, again.told, again.state()) == (3, 3, {"at": "three"})


def test_a_missing_row_is_damage_not_data(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr", budget=3 * CHUNK)
    run.append(*points(2 * CHUNK), Kind.RANDOM, 1.0)
    run.save(lambda: {})
    (tmp_path / "run.zarr/status/c/1").unlink()
    with pytest.raises(
        StoreError, match=f"rows {CHUNK + 1} to {2 * CHUNK} differ from what was written; .* start the run again"
    ):
        RunStore.open(tmp_path / "run.zarr")


def whole_run(path: Path) -> RunStore:
    """A run of several chunks, whose optimiser has been told two thirds of it."""
    run = run_at(path, budget=3 * CHUNK)
    run.append(*points(2 * CHUNK), Kind.RANDOM, 1.0)
    run.save(lambda: {"at": np.arange(3.0)})
    run.append(*points(10, start=2 * CHUNK), Kind.RANDOM, 1.0)
    run.save()
    return run


def told_of(path: Path, whole: xr.Dataset) -> str:
    """Return why a run is refused; nothing where it is not, and then it has to be whole."""
    try:
        found = RunStore.open(path).dataset()
    except StoreError as error:
        return str(error)
    xr.testing.assert_identical(found, whole)
    return ""


@pytest.mark.parametrize("damage", ["flipped", "cut", "removed", "empty", "swapped"])
def test_whatever_file_of_a_run_is_damaged_it_is_refused_by_name_or_read_right(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "run.zarr"
    whole, refused = whole_run(path).dataset(), 0
    files = sorted(file for file in path.rglob("*") if file.is_file())
    for number, file in enumerate(files):
        other = files[number - 1]
        content, next_content = file.read_bytes(), other.read_bytes()
        middle = len(content) // 2
        if damage == "removed":
            file.unlink()
        elif damage == "swapped":
            file.write_bytes(next_content)
            other.write_bytes(content)
        else:
            flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
            file.write_bytes({"flipped": flipped, "cut": content[:middle], "empty": b""}[damage])
        said = told_of(path, whole)
        assert not said or str(path) in said
        refused += bool(said)
        file.write_bytes(content)
        other.write_bytes(next_content)
    assert refused > len(files) / 2
    xr.testing.assert_identical(RunStore.open(path).dataset(), whole)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Return where the leaves of a JSON value are."""
    if isinstance(value, (dict, list)) and value:
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from leaves(value[key], (*path, key))
    else:
        yield path


def test_what_a_run_says_of_itself_is_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    whole = whole_run(path).dataset()
    about = json.loads((path / "zarr.json").read_text())
    for place in leaves(about["attributes"]):
        changed = json.loads(json.dumps(about))
        *outer, last = place
        inner = reduce(getitem, outer, changed["attributes"])
        inner[last] = {"x": 1}
        (path / "zarr.json").write_text(json.dumps(changed))
        if place == ("gradient_cost",):  # the file `state` has it, too
            xr.testing.assert_identical(RunStore.open(path).dataset(), whole)
        else:
            with pytest.raises(StoreError, match=re.escape(str(path))):
                RunStore.open(path)


def test_a_state_that_is_no_data_is_refused_and_not_run(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (tmp_path / "sprung",)

    path = tmp_path / "run.zarr"
    run = whole_run(path)
    traps = io.BytesIO()
    trap = np.empty(1, dtype=object)
    trap[0] = Trap()
    np.savez(traps, outline=trap, **{"0": trap})
    kept = Journal.read(path)
    for planted in (pickle.dumps(Trap()), traps.getvalue()):
        (path / STATE).write_bytes(planted)
        with pytest.raises(StoreError, match="state is damaged"):
            RunStore.open(path)
        replace(kept, state=planted).write(path)  # by somebody who knows how
        with pytest.raises(StoreError, match="state is damaged"):
            RunStore.open(path).state()
    assert not (tmp_path / "sprung").exists()
    assert run.count == kept.rows


def test_memory_grows_with_the_rows_and_not_with_the_budget(tmp_path: Path) -> None:
    for run in (RunStore.in_memory(SPACE, budget=10**15), run_at(tmp_path / "run.zarr", budget=10**15)):
        for start in range(0, 300, 3):
            run.append(*points(3, start=start), Kind.RANDOM, 1.0)
        run.save(lambda: {})
        assert run.dataset().sizes["evaluation"] == 300
        run.extend(10**16)
    assert RunStore.open(tmp_path / "run.zarr").dataset().identical(run.dataset())


def test_the_budget_is_the_end_of_the_table(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr", budget=4)
    with pytest.raises(ValueError, match="4 episodes has 4 left; got 5 more"):
        run.append(*points(5), Kind.RANDOM, 1.0)


def test_other_settings_are_refused_by_name_and_another_budget_is_not(tmp_path: Path) -> None:
    run_at(tmp_path / "run.zarr", budget=7)
    with pytest.raises(StoreError, match=r"contains a run made by other settings \(seed: wanted 5, found 4\)"):
        run_at(tmp_path / "run.zarr", seed=5)
    assert run_at(tmp_path / "run.zarr", budget=70).budget == 7
    wider = ParameterSpace(SPACE.names, SPACE.lower, torch.tensor([1.0, 4.0]), SPACE.units)
    with pytest.raises(StoreError, match=r"upper\[1\]: wanted 4.0, found 3.0"):
        RunStore.open_or_create(tmp_path / "run.zarr", wider, identity=IDENTITY, budget=7)


def test_only_a_run_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.txt").write_text("precious")
    with pytest.raises(StoreError, match="is not a run and is not replaced"):
        RunStore.open_or_create(tmp_path / "mine", SPACE, identity={}, budget=3, overwrite=True)
    assert not is_run(tmp_path / "mine")
    with pytest.raises(StoreError, match="is not a run of format 2"):
        RunStore.open(tmp_path / "mine")
    with pytest.raises(StoreError, match="make one with `landscape optimize`"):
        RunStore.open(tmp_path / "nothing")
    run = run_at(tmp_path / "run.zarr")
    run.append(*points(3), Kind.RANDOM, 1.0)
    run.save(lambda: {})
    assert RunStore.open_or_create(tmp_path / "run.zarr", SPACE, identity={}, budget=3, overwrite=True).count == 0
    with pytest.raises(StoreError, match="was replaced or removed"):
        run.save(lambda: {})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "run.zarr"]


def test_a_file_of_somebody_elses_in_a_run_is_not_lost_by_force(tmp_path: Path) -> None:
    path = tmp_path / "run.zarr"
    run_at(path)
    (path / "x/thesis.txt").write_text("precious")
    with pytest.raises(ValueError, match=r"has files that do not belong to a run: x/thesis\.txt"):
        RunStore.open_or_create(path, SPACE, identity={}, budget=3, overwrite=True)
    assert (path / "x/thesis.txt").read_text() == "precious"
    (path / "x/thesis.txt").unlink()
    (path / "zarr.json").write_text("{")
    with pytest.raises(StoreError, match=r"run\.zarr/zarr\.json is damaged: .*start the run again in another"):
        RunStore.open(path)
    assert RunStore.open_or_create(path, SPACE, identity={}, budget=3, overwrite=True).budget == 3


def test_what_zarr_had_not_written_whole_goes_when_the_run_is_filled_again(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr")
    half = tmp_path / f"run.zarr/loss/c/0.{32 * 'a'}.partial"
    half.parent.mkdir(parents=True)
    half.write_bytes(b"half")
    with run.lock():
        assert not half.exists()


def test_one_process_at_a_time_fills_a_run(tmp_path: Path) -> None:
    run = run_at(tmp_path / "run.zarr")
    other = os.open(tmp_path / "run.zarr", os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    with pytest.raises(StoreError, match="being filled by another process"), run.lock():
        pass
    os.close(other)
    with run.lock():
        pass


def test_writing_takes_a_twentieth_of_the_time_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, saved = Clock(), []
    monkeypatch.setattr("gradscape.optim.runs.store.time", clock)
    run = run_at(tmp_path / "run.zarr")

    def slow_state() -> dict[str, int]:
        clock.sleep(0.4)
        saved.append(run.count)
        return {}

    for number in range(60):
        clock.sleep(0.3)
        run.append(*points(1, start=number), Kind.RANDOM, 0.3, slow_state)
    assert saved == [4, 31, 58]  # after the first second, then after 0.4 s / 5 % = 8 s each
    assert Journal.read(tmp_path / "run.zarr").rows == 58
