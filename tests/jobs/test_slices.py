"""The table of slices: right however slices come, change and go, and made without opening one."""

import faulthandler
import json
import os
import shutil
import sqlite3
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import gradscape as gs
from gradscape.jobs import slices as module
from gradscape.jobs.slices import TABLE, find_slices
from gradscape.jobs.workers import workers
from gradscape.landscapes.sampling.distribution import run_tasks

from ..processes import FORK


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the summary of a slice."""
    folder = tmp_path_factory.mktemp("made") / "one"
    gs.slice("branin", (0, 1), resolution=2, out=folder, picture=False)
    found: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    assert "landscape.png" not in found["files"]
    return found


@pytest.fixture
def many(tmp_path: Path, made: dict[str, Any]) -> Path:
    """Return a folder of three slices, at two depths, whose samples cannot be read."""
    for lowest, name in enumerate(("a", "b", "deep/c")):
        put(tmp_path / name, made, lowest)
    return tmp_path


def put(folder: Path, summary: dict[str, Any], lowest: float, text: str = "") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "slice.zarr.zip").write_bytes(b"")
    said = summary | {"loss": {"lowest": lowest, "highest": 9.0}}
    partial = folder / "summary.partial"
    partial.write_text(text or json.dumps(said))
    partial.replace(folder / "summary.json")


def lowest(folder: Path, where: str | None = None) -> dict[str, float]:
    table = gs.slices(folder, where)
    return {os.path.relpath(name, folder): value for name, value in zip(table["folder"], table["lowest"], strict=True)}


def test_the_table_follows_slices_that_come_change_move_and_go(many: Path, made: dict[str, Any]) -> None:
    assert lowest(many) == {"a": 0, "b": 1, "deep/c": 2}
    put(many / "a", made, 5)
    put(many / "d", made, 3)
    (many / "b").rename(many / "deep/e")
    shutil.rmtree(many / "deep/c")
    assert lowest(many) == {"a": 5, "d": 3, "deep/e": 1}
    for one, other in (("a", "x"), ("d", "a"), ("x", "d")):
        (many / one).rename(many / other)
    assert lowest(many) == {"a": 3, "d": 5, "deep/e": 1}
    (many / TABLE).unlink()
    assert lowest(many) == {"a": 3, "d": 5, "deep/e": 1}
    assert lowest(many / "a") == {".": 3}


def test_a_summary_is_read_once(many: Path, made: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    read, row = list[str](), module._row
    monkeypatch.setattr(module, "_row", lambda folder, name, stamp: read.append(name) or row(folder, name, stamp))
    for _ in range(2):
        lowest(many)
    put(many / "a", made, 7)
    lowest(many)
    assert sorted(read) == ["a", "a", "b", "deep/c"]


def test_what_is_no_summary_of_a_slice_is_counted_or_left_out(many: Path, made: dict[str, Any]) -> None:
    put(many / "a", made, 0, '{"env": "branin"')
    put(many / "b", made, 0, json.dumps(made | {"status": {}}))
    put(many / "sweep", made, 0, '{"env": "branin", "frames": []}')
    (many / "run/run.zarr").mkdir(parents=True)
    (many / "run/summary.json").write_text('{"env": "branin"}')
    (many / "begun/slice.filling").mkdir(parents=True)
    (many / ".left.making").mkdir()
    found = find_slices(many)
    assert (len(found.rows), found.damaged, found.bare) == (1, 2, 1)
    assert list(find_slices(many / "deep").rows["folder"]) == [str(many / "deep/c")]


@pytest.mark.parametrize("content", [b"", b"my own notes", b"cut", None])
def test_a_table_that_is_damaged_or_cannot_be_written_changes_no_row(many: Path, content: bytes | None) -> None:
    whole = gs.slices(many)
    if content is None:
        (many / TABLE).unlink()
        (many / TABLE).mkdir()
    else:
        sound = (many / TABLE).read_bytes()
        (many / TABLE).write_bytes(sound[:5000] if content == b"cut" else content)
    for _ in range(3):
        pd.testing.assert_frame_equal(gs.slices(many), whole)
    assert (many / TABLE).is_dir() == (content is None)


def test_no_byte_of_the_table_changes_a_row(many: Path) -> None:
    whole, sound = gs.slices(many), (many / TABLE).read_bytes()
    for at in range(0, len(sound), 17):
        (many / TABLE).write_bytes(sound[:at] + bytes([sound[at] ^ 16]) + sound[at + 1 :])
        pd.testing.assert_frame_equal(gs.slices(many), whole)


def test_a_table_of_another_version_is_made_again(many: Path) -> None:
    whole = gs.slices(many)
    with closing(sqlite3.connect(many / TABLE)) as table, table:
        table.execute("ALTER TABLE slices DROP COLUMN lowest")
        table.execute("PRAGMA user_version = 3")
    pd.testing.assert_frame_equal(gs.slices(many), whole)


def test_processes_may_make_the_table_at_once(many: Path, made: dict[str, Any]) -> None:
    for number in range(200):
        put(many / f"{number:03d}", made, number)
    with ProcessPoolExecutor(3, mp_context=FORK) as pool:
        found = list(pool.map(gs.slices, [many] * 6))
    (many / TABLE).unlink()
    for one in found:
        pd.testing.assert_frame_equal(one, gs.slices(many))


def test_a_condition_chooses_rows_and_a_wrong_one_is_refused(many: Path) -> None:
    assert lowest(many, "env == 'branin' and lowest > 0") == {"b": 1, "deep/c": 2}
    assert lowest(many, "folder like 'deep/%' -- those") == {"deep/c": 2}
    assert len(gs.slices(many, "0")) == 0
    assert lowest(many, "1) or (1") == lowest(many)
    for wrong in ("jumps > 0.1", "lowest >", "1; DROP TABLE slices", "lowest > \0"):
        with pytest.raises(ValueError, match=r"takes an SQLite condition over folder, env, .*; got"):
            gs.slices(many, wrong)
    with pytest.raises(ValueError, match="there is no folder"):
        gs.slices(many / "nowhere")


def test_a_name_that_is_not_unicode_is_one_all_the_same(many: Path, made: dict[str, Any]) -> None:
    odd = many / os.fsdecode(b"caf\xe9")
    put(odd, made | {"command": "landscape slice branin --out caf\udce9"}, 4)
    for _ in range(2):
        assert lowest(many)[odd.name] == 4
    shutil.rmtree(odd)
    assert odd.name not in lowest(many)


@pytest.mark.parametrize("count", [20, pytest.param(10_000, marks=pytest.mark.nightly)])
def test_slices_of_two_workers_are_written_listed_and_queried(tmp_path: Path, count: int) -> None:
    """A slice to a task, each in one file, and none opened afterwards."""
    if count > 20:
        faulthandler.cancel_dump_traceback_later()  # 15 minutes of a core: half an hour and more beside other programs

    def cut(number: int) -> float:
        import gradscape

        window = 0.1 + 0.8 * number / 10_000
        where = {"resolution": 8, "window": window, "out": tmp_path / f"{number // 100:03d}" / f"{number:05d}"}
        return float(gradscape.slice("branin", (0, 1), picture=False, **where).data["loss"].min())

    with workers("local:2", "cpu") if count > 20 else ThreadPoolExecutor(2) as executor:
        assert executor is not None
        found = sorted(run_tasks(executor, cut, [(number,) for number in range(count)]))
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert len(files) == 2 * count
    assert sum(file.stat().st_size for file in files) < 12_000 * count
    for file in files:
        if file.suffix == ".zip":
            file.write_bytes(b"")  # nothing is opened
    listed = gs.slices(tmp_path)
    assert sorted(listed["lowest"]) == found
    middle = found[count // 2]
    assert sorted(gs.slices(tmp_path, f"env = 'branin' and lowest > {middle}")["lowest"]) == [
        one for one in found if one > middle
    ]
