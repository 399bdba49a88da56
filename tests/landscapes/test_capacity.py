"""What a machine has room for."""

import math
from pathlib import Path

import pytest

from gradscape import ParameterSpace, Plane
from gradscape.landscapes import capacity
from gradscape.landscapes.capacity import Need, TooLargeError, require
from gradscape.landscapes.storage.arrays import need_of
from gradscape.landscapes.storage.store import SliceStore


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with 1 MB of memory and 2 MB of disk."""
    monkeypatch.setattr(capacity, "available_memory", lambda: 1e6)
    monkeypatch.setattr(capacity, "free_disk", lambda folder: 2e6)


@pytest.mark.usefixtures("small")
def test_what_does_not_fit_is_refused_with_what_would(tmp_path: Path) -> None:
    require("points", 1000, lambda count: Need(memory=1000.0 * count))
    with pytest.raises(TooLargeError, match=r"points 1234 needs about 1 MB of memory, .* points 1000 would fit"):
        require("points", 1234, lambda count: Need(memory=1000.0 * count))
    with pytest.raises(TooLargeError, match="of disk, but only 2 MB are free here; files 20 would fit"):
        require("files", 10**30, lambda count: Need(disk=1e5 * count), tmp_path)
    require("files", 10**30, lambda count: Need(disk=1e5 * count))  # nothing is written
    with pytest.raises(TooLargeError, match="not even seeds 1 would fit"):
        require("seeds", 1, lambda count: Need(memory=2e6))


@pytest.mark.usefixtures("small")
def test_a_slice_beyond_the_machine_is_refused_before_it_is_made(tmp_path: Path) -> None:
    space = ParameterSpace.box(["a", "b"], -1.0, 1.0)
    plane = Plane.through(space, space.center, ("a", "b"), resolution=(100, 1000))
    with pytest.raises(TooLargeError, match="resolution 1000 needs"):
        SliceStore.create(tmp_path / "slice.zarr", plane, space, identity={"objective": "none"})
    assert not list(tmp_path.iterdir())
    with pytest.raises(TooLargeError, match="resolution 1000 needs"):
        SliceStore.in_memory(plane, space)


def test_a_group_of_processes_has_what_its_limit_leaves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files in memory can be given back, so they do not count."""
    group = tmp_path / "job"
    group.mkdir()
    for name, text in (("max", "3000"), ("current", "2000"), ("stat", "anon 1500\ninactive_file 500\n")):
        (group / f"memory.{name}").write_text(text)
    (tmp_path / "memory.max").write_text("max")
    assert capacity._free_in_group(group) == [1500.0]
    assert capacity._free_in_group(tmp_path) == []
    monkeypatch.setattr(capacity, "_group_limits", lambda: [1500.0, math.inf])
    assert capacity.available_memory() == 1500.0


def test_what_a_slice_takes_grows_with_its_points_and_its_gradients() -> None:
    plain, sloped, larger = (
        need_of((side, side), 3, grad=grad) for side, grad in ((64, False), (64, True), (128, True))
    )
    assert plain.memory < sloped.memory
    assert larger.memory == 4 * sloped.memory
    assert plain.disk < sloped.disk < larger.disk


def test_bytes_are_said_in_words() -> None:
    assert [capacity.size(count) for count in (10, 2.5e6, 3e9, 4e12)] == ["0 kB", "2 MB", "3.0 GB", "4.0 TB"]
