"""Recordings of episodes hold what the episode says, once where it rests, and are equal where episodes are."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader

from gradscape.landscapes.draw.recordings.episode import save_episode
from gradscape.landscapes.draw.render.solids import mesh
from gradscape.landscapes.episode import Episode, Part, View

pytestmark = pytest.mark.slow

FRAMES = 4
TIME = torch.arange(FRAMES, dtype=torch.float64) / 8
WAY = torch.linspace(0.0, 0.5, FRAMES, dtype=torch.float64)[:, None, None] * torch.tensor([1.0, 0.5, 0.0])
SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], dtype=torch.float64)
FACES = torch.tensor([[0, 2, 1], [0, 3, 2]])
QUARTERS = torch.tensor([[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]] * 2).double()
PARTS = (
    Part("sphere", "rubber", WAY, (0.1,)),
    Part("trail", "rubber", WAY, (0.01,)),
    Part("lump", "plasticine", WAY + torch.rand(FRAMES, 500, 3, dtype=torch.float64), (0.1,)),
    Part("sheet", "cloth", WAY + SQUARE, faces=FACES),
    Part("box", "wood", torch.zeros(FRAMES, 2, 3, dtype=torch.float64), (0.2, 0.3, 0.4)),
    Part("capsule", "wood", WAY, (0.2, 0.1), QUARTERS),
    Part("lump", "target", torch.rand(1, 500, 3, dtype=torch.float64).expand(FRAMES, -1, -1), (0.1,)),
)
EPISODE = Episode(TIME, {}, {}, PARTS, View((0, 0, 0), (2, 1, 1)))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recording") / "episode.rrd"
    save_episode(EPISODE, file, title="test")
    return file


@pytest.fixture(scope="module")
def held(path: Path) -> dict[str, dict[str, list]]:
    """Return what each entity holds, component -> its rows in time order; static ones are one row."""
    found: dict[str, dict[str, list]] = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(str(path)).stream().to_chunks():
        table = chunk.to_record_batch()
        for name in table.schema.names:
            kind = name.rpartition(":")[2]
            found[str(chunk.entity_path)][kind] += [row for row in table.column(name).to_pylist() if row is not None]
    return found


def entity(held: dict[str, dict[str, list]], part: int) -> dict[str, list]:
    (name,) = [name for name in held if name.startswith(f"/episode/{part + 1:02d}_")]
    return held[name]


def test_solids_are_one_surface_that_takes_the_episodes_poses(held) -> None:
    for number in (0, 5):
        ball = entity(held, number)
        assert len(ball["vertex_positions"]) == 1
        np.testing.assert_allclose(np.array(ball["translations"])[:, 0], WAY[:, 0], atol=1e-6)
    body = mesh(replace(PARTS[0], at=torch.zeros(1, 1, 3)), 0)
    np.testing.assert_allclose(entity(held, 0)["vertex_positions"][0], body.points, atol=1e-6)
    turns = np.array(entity(held, 5)["mat3x3"]).reshape(FRAMES, 3, 3).transpose(0, 2, 1)  # column by column
    np.testing.assert_allclose(turns, QUARTERS, atol=1e-6)


def test_a_frame_stands_at_its_second(held) -> None:
    seconds = [time.total_seconds() for time in entity(held, 0)["time"]]
    assert seconds == pytest.approx(TIME.tolist())
    assert "time" not in entity(held, 4)


def test_bodies_sheets_and_trails_are_where_the_episode_has_them(held) -> None:
    np.testing.assert_allclose(np.array(entity(held, 2)["positions"]), PARTS[2].at, atol=1e-6)
    cloth = entity(held, 3)
    np.testing.assert_allclose(np.array(cloth["vertex_positions"]), PARTS[3].at, atol=1e-6)
    assert np.array(cloth["triangle_indices"]).tolist() == [FACES.tolist()]
    assert [len(strip[0]) for strip in entity(held, 1)["strips"]] == [1, 2, 3, 4]


def test_what_rests_is_written_once(held) -> None:
    assert np.array(entity(held, 4)["translations"]).shape == (1, 2, 3)
    goal = entity(held, 6)
    assert (len(goal["vertex_positions"]), len(goal["triangle_indices"])) == (1, 1)
    assert goal["albedo_factor"][0][0] & 0xFF < 128  # it is seen through


def test_many_points_are_thinned_and_many_frames_skipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gradscape.landscapes.draw.recordings.episode.MAX_POINTS", 1000)
    file = tmp_path / "few.rrd"
    save_episode(replace(EPISODE, parts=PARTS[2:3]), file, title="test", longest=2)
    rows = [
        row
        for chunk in RrdReader(str(file)).stream().to_chunks()
        for name in chunk.to_record_batch().schema.names
        if name.endswith(":positions")
        for row in chunk.to_record_batch().column(name).to_pylist()
    ]
    assert [len(row) for row in rows] == [250, 250]


def test_equal_episodes_give_equal_recordings_and_others_do_not(
    path: Path, tmp_path: Path, rerun: Callable[..., int]
) -> None:
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    save_episode(EPISODE, again, title="test")
    save_episode(replace(EPISODE, time=2 * TIME), other, title="test")
    assert rerun("rrd", "compare", str(path), str(again)) == 0
    assert rerun("rrd", "compare", str(path), str(other)) != 0
    assert rerun("rrd", "verify", str(path)) == 0
