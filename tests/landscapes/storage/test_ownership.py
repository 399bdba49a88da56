"""What is replaced or removed is ours, all of it; what is being made is held, and what a kill left is not."""

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
import torch
from torch import Tensor

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.identity import StoreError
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.checkpoint import Checkpoint
from gradscape.landscapes.storage.files import discard, placing, remove, replacing, tidy
from gradscape.landscapes.storage.paths import filling_path
from gradscape.landscapes.storage.store import SliceStore

from ...processes import alone
from .stores import unpacked

SPACE = ParameterSpace.box(("x", "y"), -1.0, 1.0)
PLANE = Plane.through(SPACE, SPACE.center, ("x", "y"), resolution=9)
MINE = ["notes.txt", "loss/notes.txt", "loss/c/0/notes.txt", ".git/HEAD", "mass/zarr.json", "pieces/notes.txt"]


def bowl(x: Tensor) -> Tensor:
    return x.square().sum(dim=1)


def make(path: Path, *, overwrite: bool = False) -> SliceStore:
    return SliceStore.create(path, PLANE, SPACE, identity={"objective": "bowl"}, overwrite=overwrite)


def finished(path: Path) -> Path:
    """Return the folder of a finished slice, as earlier versions left it."""
    sample(from_torch(bowl, SPACE), PLANE, make(path))
    return unpacked(path)


def unfinished(path: Path) -> Path:
    store = make(path)
    tile = store.tiles()[0]
    store.write(tile, from_torch(bowl, SPACE).evaluate(store.points(tile)))
    return filling_path(path)


def own(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("mine", MINE)
@pytest.mark.parametrize("made", [finished, unfinished])
def test_a_slice_with_anything_else_in_it_is_not_replaced(
    made: Callable[[Path], Path], mine: str, tmp_path: Path
) -> None:
    file = made(tmp_path / "slice.zarr") / mine
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("precious")
    with pytest.raises(ValueError, match=rf"because it has files that do not belong to a slice: {mine}; move"):
        make(tmp_path / "slice.zarr", overwrite=True)
    assert file.read_text() == "precious"
    file.unlink()
    assert make(tmp_path / "slice.zarr", overwrite=True).pending()
    assert own(tmp_path) == ["slice.filling"]


def test_a_link_in_a_slice_is_not_ours_unless_it_leads_nowhere(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    link = finished(tmp_path / "slice.zarr") / "loss/c/7"
    link.symlink_to(tmp_path / "mine")
    with pytest.raises(ValueError, match="do not belong to a slice: loss/c/7;"):
        make(tmp_path / "slice.zarr", overwrite=True)
    link.unlink()
    link.symlink_to(link)
    assert make(tmp_path / "slice.zarr", overwrite=True).pending()


@pytest.mark.parametrize("made", [finished, unfinished])
@pytest.mark.parametrize("damage", [None, "", "{", "[1]", '{"attributes": 3, "checksum": 0}'])
def test_a_slice_without_its_root_can_be_begun_anew_as_its_refusal_says(
    made: Callable[[Path], Path], damage: str | None, tmp_path: Path
) -> None:
    place = made(tmp_path / "slice.zarr")
    root = place / ("zarr.json" if made is finished else "slice.json")
    root.unlink() if damage is None else root.write_text(damage)
    with pytest.raises(StoreError, match=rf"{root.name} is damaged .*; restore it, or sample the slice again"):
        SliceStore.open(tmp_path / "slice.zarr")
    assert make(tmp_path / "slice.zarr", overwrite=True).pending()


@pytest.mark.parametrize("content", [b"", b"cut", b"my own file", None])
def test_a_file_in_the_place_of_a_slice_is_replaced_only_if_it_was_one(tmp_path: Path, content: bytes | None) -> None:
    sample(from_torch(bowl, SPACE), PLANE, make(tmp_path / "slice.zarr"))
    archive = tmp_path / "slice.zarr.zip"
    if content is None:
        with ZipFile(archive, "w") as mine:
            mine.writestr("thesis.tex", "five years")
    else:
        archive.write_bytes(archive.read_bytes()[:4000] if content == b"cut" else content)
    if content in (b"", b"cut"):
        with pytest.raises(StoreError, match=r"slice\.zarr\.zip is damaged .*; restore it, or sample the slice again"):
            SliceStore.open(tmp_path / "slice.zarr")
        assert make(tmp_path / "slice.zarr", overwrite=True).pending()
        assert own(tmp_path) == ["slice.filling"]
    else:
        with pytest.raises(StoreError, match="is not a slice store and is not replaced"):
            make(tmp_path / "slice.zarr", overwrite=True)
        assert own(tmp_path) == ["slice.zarr.zip"]


def test_another_zarr_store_of_our_names_is_not_replaced(tmp_path: Path) -> None:
    root = finished(tmp_path / "slice.zarr") / "zarr.json"
    root.write_text('{"zarr_format": 3, "node_type": "group", "attributes": {"title": "wind"}}')
    with pytest.raises(StoreError, match="is not a slice store and is not replaced"):
        make(tmp_path / "slice.zarr", overwrite=True)
    with pytest.raises(StoreError, match=r"not a slice store of format(?!.*--force)"):
        SliceStore.open(tmp_path / "slice.zarr")


def test_what_somebody_put_among_the_tiles_stays_when_they_go(tmp_path: Path) -> None:
    store = make(tmp_path / "slice.zarr")
    mine = filling_path(tmp_path / "slice.zarr") / "pieces/notes.txt"
    mine.parent.mkdir()
    mine.write_text("precious")
    sample(from_torch(bowl, SPACE), PLANE, store)
    assert mine.read_text() == "precious"
    assert [path for path in filling_path(tmp_path / "slice.zarr").rglob("*") if path.is_file()] == [mine]
    assert not SliceStore.open(tmp_path / "slice.zarr").pending()


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("said", ["", "{", "[]", "{}", '{"kind": 3}', '{"editor.fontSize": 12}'])
def test_settings_of_something_else_are_no_study(said: str, force: bool, tmp_path: Path) -> None:
    (tmp_path / "settings.json").write_text(said)
    (tmp_path / "pieces").mkdir()
    (tmp_path / "pieces/queen.obj").write_text("precious")
    with pytest.raises(ValueError, match=r"settings\.json is damaged \(.+\); .* write elsewhere with --out"):
        Checkpoint.open(tmp_path, {"seed": 0}, what="pairs", force=force)
    assert (tmp_path / "settings.json").read_text() == said
    assert (tmp_path / "pieces/queen.obj").read_text() == "precious"


def test_a_study_with_anything_else_among_its_pieces_is_not_begun_anew(tmp_path: Path) -> None:
    checkpoint = Checkpoint.open(tmp_path, {"seed": 0}, what="pairs")
    checkpoint.save("one", loss=torch.zeros(2).numpy())
    (tmp_path / "pieces/queen.obj").write_text("precious")
    with pytest.raises(ValueError, match=r"has files that do not belong to a pairs: queen\.obj; move"):
        Checkpoint.open(tmp_path, {"seed": 1}, what="pairs", force=True)
    assert checkpoint.count() == 1
    (tmp_path / "pieces/queen.obj").unlink()
    assert Checkpoint.open(tmp_path, {"seed": 1}, what="pairs", force=True).count() == 0


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda one, other: b"", ".+"),
        (lambda one, other: b"PK", ".+"),
        (lambda one, other: one[: len(one) // 2] + b"?" + one[len(one) // 2 + 1 :], ".+"),
        (lambda one, other: other, "it is another part"),
    ],
)
def test_a_damaged_piece_is_said_and_computed_again(
    damage: Callable[[bytes, bytes], bytes], said: str, tmp_path: Path
) -> None:
    checkpoint = Checkpoint.open(tmp_path, {"seed": 0}, what="pairs")
    for name in ("one", "two"):
        checkpoint.save(name, loss=np.arange(99.0))
    file, other = (tmp_path / f"pieces/{name}.npz" for name in ("one", "two"))
    file.write_bytes(damage(file.read_bytes(), other.read_bytes()))
    with pytest.warns(RuntimeWarning, match=rf"{file} is damaged \({said}\); it is computed again"):
        assert checkpoint.load("one") is None


def test_what_a_living_process_makes_is_held_and_nobody_clears_it_away(tmp_path: Path) -> None:
    file, folder = tmp_path / "file", tmp_path / "folder"
    with replacing(file) as half, placing(folder, overwrite=False) as new:
        half.write_text("whole")
        new.mkdir()
        tidy(tmp_path)
        with replacing(file) as other:
            other.write_text("another's")
        discard(folder)
        assert (half.read_text(), new.is_dir()) == ("whole", True)
    assert (file.read_text(), own(tmp_path)) == ("whole", ["file", "folder"])


def test_what_is_cleared_away_before_it_is_held_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hold, early = os.open, [1]

    def late(path: Path, *how: Any, **more: Any) -> int:
        if early:
            early.pop()
            path.rmdir()
        return hold(path, *how, **more)

    monkeypatch.setattr(os, "open", late)
    with replacing(tmp_path / "file") as half:
        half.write_text("whole")
    assert own(tmp_path) == ["file"]


def killed(path: Path) -> None:
    with replacing(path) as half:
        half.write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)


def test_what_a_kill_leaves_goes_with_the_next_of_its_name_and_at_the_end_of_a_job(tmp_path: Path) -> None:
    for name in ("file", "deep/other"):
        assert alone(partial(killed, tmp_path / name), tmp_path).returncode == -signal.SIGKILL
    (left,) = tmp_path.glob(".file.*")
    with replacing(tmp_path / "file") as whole:
        assert not left.exists()
        whole.write_text("whole")
    assert len(list(tmp_path.glob("deep/.*"))) == 1
    tidy(tmp_path)
    assert not list(tmp_path.glob("deep/.*"))


def test_a_folder_that_cannot_be_put_in_its_place_leaves_the_one_that_is_there(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/mine").write_text("precious")

    def refuse() -> None:
        raise ValueError("somebody has put a file there meanwhile")

    with (
        pytest.raises(ValueError, match="meanwhile"),
        placing(tmp_path / "folder", overwrite=True, check=refuse) as new,
    ):
        new.mkdir()
    with pytest.raises(FileNotFoundError), placing(tmp_path / "folder", overwrite=True):
        pass  # nothing is made
    assert (tmp_path / "folder/mine").read_text() == "precious"


@pytest.mark.parametrize("gone", ["pieces", "."])
def test_what_another_process_removes_meanwhile_is_removed(gone: str, tmp_path: Path) -> None:
    """Two processes that fill the same slice clear its tiles away at once: the other is first in the middle of it."""
    folder = unfinished(tmp_path / "s.zarr")

    def ours(name: str) -> bool:
        discard(folder / gone)
        return True

    remove(folder, ours)
    assert not folder.exists()
