import math
import resource
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import parse_qs

import numpy as np
import pytest
import torch
from rerun.chunk import RrdReader

from gradscape.envs.adapters import from_torch
from gradscape.landscapes.draw.recordings import viewer
from gradscape.landscapes.draw.recordings.runs import HEIGHT, SIDE, save_stream
from gradscape.landscapes.overlay import overlay
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace

from ....processes import alone
from ...made_runs import run_table
from ..figures.test_search import luminance

pytestmark = pytest.mark.slow

SPACE = ParameterSpace.box(("a", "b", "c"), -1.0, 1.0, "m")


def bowl(x):
    return torch.where((x[:, :2] > 0.6).all(dim=1), torch.nan, x.square().sum(dim=1))


BOWL = from_torch(bowl, SPACE, name="bowl")
run = partial(run_table, BOWL, method="bo-leap", seed=0)


DESCENT = np.array([0.8, -0.5, 0.4]) * 0.8 ** np.arange(5)[:, None]
POINTS = np.concatenate([np.random.default_rng(0).uniform(-0.5, 0.5, (6, 3)), DESCENT, [[0.9, 0.8, 0.0]]])
SLICE = sample(BOWL, Plane.through(SPACE, SPACE.center, ("a", "b"), resolution=9))
LAID = overlay(SLICE, [run(POINTS, [3] + [1] * 5 + [2] * 5 + [1]), run(POINTS[:3], [1] * 3, seed=1)])


def columns(path: Path) -> dict[str, dict[str, list]]:
    """Return what each entity holds, by component, and its rows' times under the timeline's name."""
    found: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        held = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names[1:]:
            held.setdefault(name.rpartition(":")[2], []).extend(batch[name].to_pylist())
    return found


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("stream") / "overlay.rrd"
    save_stream(SLICE, LAID, path)
    return path


@pytest.fixture(scope="module")
def held(path: Path) -> dict[str, dict[str, list]]:
    return columns(path)


def test_every_kind_of_point_is_an_entity_of_its_own_and_known_when_it_was_evaluated(held) -> None:
    root = "/landscape/runs/bo-leap-s0"
    wanted = {"acquisition": [1], "population": [2, 3, 4, 5, 6], "descent": [7, 8, 9, 10, 11], "failed": [12]}
    for name, times in wanted.items():
        assert held[f"{root}/{name}"]["evaluation"] == times
    assert held[f"{root}/descents"]["evaluation"] == [8, 9, 10, 11]
    assert held["/landscape/runs/bo-leap-s1/population"]["evaluation"] == [1, 2, 3]


def test_nothing_but_evaluations_is_a_time(path: Path) -> None:
    chunks = RrdReader(path).stream().to_chunks()
    assert {name for chunk in chunks for name in chunk.timeline_names} == {"evaluation"}
    static = {chunk.entity_path for chunk in chunks if chunk.is_static}
    assert static >= {"/landscape/surface", "/landscape/descent_directions", "/landscape/axes/u", "/about"}


def test_points_stand_at_their_true_loss_and_lines_join_them_to_the_surface(held) -> None:
    laid, root = LAID[0], "/landscape/runs/bo-leap-s0"
    losses = np.concatenate([SLICE["loss"].values.ravel(), *(one["loss"].values for one in LAID)])
    low, high = np.nanmin(losses), np.nanmax(losses)
    place = np.array([rows[0] for rows in held[f"{root}/descent"]["positions"]])
    half = 1.0 + 0.25 / 2  # of the window: the box and half a sample
    np.testing.assert_allclose(place[:, 0], laid["u"][6:11] / half * SIDE / 2, atol=1e-6)
    np.testing.assert_allclose(place[:, 2], HEIGHT * (laid["loss"][6:11] - low) / (high - low), atol=1e-6)
    gaps = np.array([rows[0] for rows in held[f"{root}/gaps"]["strips"]])
    times = np.array(held[f"{root}/gaps"]["evaluation"])
    apart = np.abs(gaps[:, 1, 2] - gaps[:, 0, 2]) * (high - low) / HEIGHT
    np.testing.assert_allclose(apart, np.abs(laid["loss"] - laid["beneath"])[times - 1], atol=1e-6)
    np.testing.assert_array_equal(gaps[:, 0, :2], gaps[:, 1, :2])


def test_points_shrink_with_their_distance_from_the_plane(held) -> None:
    radii = np.ravel(held["/landscape/runs/bo-leap-s0/population"]["radii"])
    order = np.argsort(LAID[0]["distance"].values[1:6])
    assert (np.diff(radii[order]) < 0).all()


def test_samples_that_failed_are_holes_in_the_surface(held) -> None:
    names = ("triangle_indices", "vertex_positions", "vertex_normals")
    triangles, vertices, normals = (np.array(held["/landscape/surface"][name][0]) for name in names)
    failed = np.isnan(SLICE["loss"].values)
    assert failed.sum() == 4
    tops = normals[triangles][:, :, 2] == 1  # flat, each over its sample
    assert (tops.all(axis=1) == tops.any(axis=1)).all()
    places = vertices[triangles[tops.all(axis=1)]]
    assert len(places) == 2 * (81 - 4)
    assert np.ptp(places[..., 2], axis=1).max() < 1e-6
    side = SIDE / 9
    cells = np.floor((places.mean(axis=1)[:, :2] + SIDE / 2) / side).astype(int)
    assert not failed[cells[:, 1], cells[:, 0]].any()


def test_arrows_point_down_the_slope_and_lie_on_the_surface(held) -> None:
    (vectors,), (origins,) = (held["/landscape/descent_directions"][name] for name in ("vectors", "origins"))
    vectors, middle = np.array(vectors), np.array(origins) + np.array(vectors) / 2
    assert len(vectors) == 81 - 4 - 1  # the failed ones, and the flat middle
    np.testing.assert_allclose(vectors[:, 0] * middle[:, 1] - vectors[:, 1] * middle[:, 0], 0, atol=1e-6)
    assert ((vectors[:, :2] * middle[:, :2]).sum(axis=1) < 0).all()
    assert (vectors[:, 2] < 1e-6).all()


def test_the_best_loss_is_a_curve(held) -> None:
    curve = held["/best/bo-leap-s0"]
    np.testing.assert_allclose(np.ravel(curve["scalars"][-12:]), LAID[0]["best"])


def test_the_legend_says_where_it_comes_from_and_what_failed(held) -> None:
    text = held["/about"]["text"][0][0]
    assert "| bo-leap-s0 | 12 | 1 | 0 |" in text
    assert "gradscape 0." in text


def test_equal_runs_give_equal_recordings_and_others_do_not(
    path: Path, tmp_path: Path, rerun: Callable[..., int]
) -> None:
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    save_stream(SLICE, LAID, again)
    save_stream(SLICE, overlay(SLICE, [run(POINTS + 1e-3, [1] * 12)]), other)
    assert rerun("rrd", "compare", str(path), str(again)) == 0
    assert rerun("rrd", "compare", str(path), str(other)) != 0
    assert rerun("rrd", "verify", str(path)) == 0


@pytest.fixture
def address(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(viewer, "START_LIMIT", math.inf)
    named = tmp_path / "über die Ebene, 100% #1?&+.rrd"
    named.write_bytes(path.read_bytes())
    with viewer.serve_recording(named) as address:
        yield address


def test_a_recording_is_served_to_this_machine_alone_and_its_page_may_call_nobody(
    path: Path, address: str, tmp_path: Path
) -> None:
    root, _, query = address.partition("/?")
    assert root.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(root) as page:
        assert b"Rerun Viewer" in page.read()
        assert page.headers["Content-Security-Policy"].startswith("default-src 'self'")
        assert "http" not in page.headers["Content-Security-Policy"]
    (recorded,) = parse_qs(query)["url"]  # as the page reads it, which asks for it then
    with urllib.request.urlopen(recorded) as recording:
        assert recording.read() == path.read_bytes()
    evil = {"Host": "evil.example"}
    for asked, headers, code in ((f"{root}/other.rrd", {}, 404), (f"{root}/%00", {}, 404), (recorded, evil, 421)):
        with pytest.raises(HTTPError, match=str(code)) as refused:
            urllib.request.urlopen(urllib.request.Request(asked, headers=headers))
        refused.value.close()
    assert not list(tmp_path.rglob("analytics*"))  # rerun keeps what it would send there


@pytest.mark.parametrize("ground", [0xECECECFF, 0x1C1C1EFF], ids=["light", "dark"])
def test_every_label_is_legible_on_what_the_viewer_lays_under_it(held, ground: int) -> None:
    """A label has the colour of its point. WCAG asks for 3:1 of large type; no one colour has more than 3.8 on both."""
    seen = 0
    for components in held.values():
        for label, color in zip(components.get("labels", []), components.get("colors", []), strict=False):
            low, high = sorted(
                luminance([part >> shift & 255 for shift in (24, 16, 8)], 255) for part in (ground, color[0])
            )
            assert (high + 0.05) / (low + 0.05) > 3.5, label
            seen += len(label)
    assert seen > 15


def test_a_server_that_ends_before_it_answers_is_not_waited_for(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "START_LIMIT", math.inf)
    monkeypatch.setattr(viewer, "_rerun", lambda *_, log: subprocess.Popen([sys.executable, "-c", ""], stderr=log))
    with pytest.raises(OSError, match="rerun's web viewer does not answer"), viewer.serve_recording(path):
        pass


def written_in_little_room(folder: Path) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, resource.RLIM_INFINITY))  # of any file, as on a full disk
    try:
        save_stream(SLICE, LAID, folder / "overlay.rrd")
    except OSError as error:
        print(error.strerror, flush=True)


def test_a_recording_that_finds_no_room_ends_with_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    said = alone(partial(written_in_little_room, tmp_path), tmp_path)
    assert said.stdout.strip() == "File too large"
    assert not list(tmp_path.iterdir())
