"""Slices along named directions: what they cover, that they continue, and how other names are refused."""

import json

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.jobs.cut import PlaneSpec, joined_points
from gradscape.jobs.scene import point_of
from gradscape.landscapes.objective import Status
from gradscape.landscapes.plane import Plane

SPACE = gs.ParameterSpace({"a": (-2, 2, "m"), "b": (0, 1, "s"), "c": (-1, 1, ""), "d": (5, 9, "")})
WIDTH = SPACE.upper - SPACE.lower


def wells(x):
    """Two wells along the first parameter, at -1 and 1, a bowl in the others."""
    u = (x - SPACE.center) / WIDTH
    return (x[:, 0] ** 2 - 1) ** 2 + (u[:, 1:] ** 2 * torch.tensor([3.0, 2.0, 1.0]).double()).sum(dim=1)


WELLS = gs.from_torch(wells, SPACE)


class Wells(gs.Environment):
    """The wells, as a scene, which takes points from files."""

    space = SPACE

    def _evaluate(self, x, *, grad):
        return WELLS.evaluate(x, grad=grad)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("center:example:aim", ["center", "example:aim"]),
        ("random:1:random:2:center", ["random:1", "random:2", "center"]),
        ("best:run:p.json", ["best:run", "p.json"]),
        ("best:center", ["best", "center"]),
        ("best:random:4:best:run", ["best", "random:4", "best:run"]),
        ("random:3", []),
        ("hessian", []),
        ("gradient", []),
        ("pca:run", []),
        ("filters:3", []),
        ("training:a:b", []),
        ("center", []),
    ],
)
def test_points_of_lines_and_planes_are_told_from_directions(text, names):
    assert joined_points(text) == names


@pytest.mark.parametrize("along", ["random:4", "gradient", "hessian"])
def test_a_slice_along_directions_reaches_as_far_as_the_box_does_along_each(along):
    for seed in range(4):
        plane = PlaneSpec(None, along, f"random:{seed}", None, 9).make(WELLS)
        for axis in range(2):
            for end in (plane.lower[axis], plane.upper[axis]):
                u = torch.zeros(2, dtype=torch.float64)
                u[axis] = end
                unit = SPACE.to_unit(plane.lift(u))
                assert (unit > -1e-9).all()
                assert (unit < 1 + 1e-9).all()
                assert abs(float(end)) == pytest.approx(0.5) or float(torch.minimum(unit, 1 - unit).min()) < 1e-9
        assert float(plane.lower.max()) <= 0 <= float(plane.upper.min())


def test_from_a_corner_that_a_direction_points_out_of_it_covers_half_a_width():
    corner = torch.stack([SPACE.lower[0], SPACE.upper[1], SPACE.upper[2], SPACE.lower[3]])
    plane = PlaneSpec(None, "random:0", corner, None, 9).make(WELLS)
    assert (plane.upper > plane.lower).all()


def test_what_is_off_the_box_is_left_out(tmp_path):
    cut = gs.slice(WELLS, along="random:1", through="random:2", resolution=12, window=1.5, out=tmp_path / "cut")
    status, plane = cut.data.status.to_numpy(), Plane.from_record(json.loads(cut.data.attrs["identity"])["plane"])
    u, v = plane.axes()
    unit = SPACE.to_unit(plane.lift(torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1))).numpy()
    outside = ((unit < -1e-9) | (unit > 1 + 1e-9)).any(axis=-1)
    assert outside.any()
    np.testing.assert_array_equal(status == Status.ESCAPED, outside)


def test_a_barrier_is_the_height_between_two_wells(tmp_path):
    for name, at in (("left", -1.0), ("right", 1.0)):
        (tmp_path / f"{name}.txt").write_text(f"{at} 0.5 0 7")
    line = gs.slice(Wells, along=f"{tmp_path}/left.txt:{tmp_path}/right.txt", resolution=23, out=tmp_path / "line")
    summary = json.loads((tmp_path / "line/summary.json").read_text())
    assert summary["barrier"] == pytest.approx(1.0)
    assert line.data.sizes["u"] == 23
    assert float(line.data.u.min()) < 0 < 1 < float(line.data.u.max())


def test_a_slice_that_was_begun_goes_on_along_its_own_directions(tmp_path, monkeypatch):
    """On a GPU gradients, and so directions, come out a little different each time; and they take many episodes."""
    first = gs.slice("bounce", along="gradient", resolution=5, out=tmp_path / "cut", device="cpu")
    from gradscape.jobs import cut as module

    exact = module._plane_along
    monkeypatch.setattr(module, "_plane_along", lambda *_, **__: pytest.fail("directions were computed again"))
    again = gs.slice("bounce", along="gradient", resolution=5, out=tmp_path / "cut", device="cpu")
    monkeypatch.setattr(module, "_plane_along", exact)
    assert again.data.loss.to_numpy().tobytes() == first.data.loss.to_numpy().tobytes()
    assert json.loads((tmp_path / "cut/summary.json").read_text())["episodes"] == 0
    with pytest.raises(ValueError, match=r"another slice|differ|other"):
        gs.slice("bounce", along="hessian", resolution=5, out=tmp_path / "cut", device="cpu")


def test_verbs_take_such_slices(run, tmp_path):
    for command in (
        ["slice", "bounce", "--along", "random:3", "--through", "random:1", "--resolution", "8", "--out", "cut"],
        ["optimize", "bounce", "--method", "random", "--budget", "6", "--fidelity", "draft", "--out", "run"],
        ["slice", "bounce", "--along", "pca:run", "--resolution", "3", "--out", "principal"],
        ["slice", "bounce", "--along", "hessian", "--through", "best:run", "--resolution", "3", "--out", "hessian"],
        ["slice", "bounce", "--along", "center:best:run:random:1", "--resolution", "3", "--out", "plane"],
        ["report", "cut", "--out", "report"],
    ):
        run.ok(*command)


def test_the_best_point_known_is_of_the_same_options(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gradscape.jobs.scene.best_of_league", lambda env: None)
    envs = [gs.make("bounce", device="cpu", target_x=x) for x in (2.0, 3.0)]
    runs = [gs.optimize(env, "random", budget=12) for env in envs]
    for env, run in zip(envs, runs, strict=True):
        np.testing.assert_array_equal(point_of(env, "best"), run.best.x)


def test_a_list_of_names_is_refused_where_a_slice_goes_through_one_point():
    with pytest.raises(ValueError, match="goes through one point here; got 2 names"):
        gs.slice("bounce", (0, 1), through=["center", "random:1"])


def test_through_several_points_there_is_a_slice_for_each(run, tmp_path):
    words = ["slice", "bounce", "--dims", "0", "1", "--through", "center,random:1,center", "--resolution", "2"]
    done = run(*words, "--json", cwd=tmp_path)
    folders = [one["folder"] for one in json.loads(done.stdout)["slices"]]
    assert len(set(folders)) == 2
    named = run(*words, "--out", "both", cwd=tmp_path)
    assert named.returncode == 0
    assert sorted(path.name for path in (tmp_path / "both").iterdir()) == ["center", "random-1"]
    ours, theirs = (gs.open_slice(tmp_path / path).data.loss for path in ("both/random-1", folders[1]))
    assert ours.equals(theirs)
    none = run("slice", "bounce", "--dims", "0", "1", "--through", "center,nowhere", "--out", "none", cwd=tmp_path)
    assert none.returncode == 2
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "a slice takes either --dims (one or two parameters) or --along (directions); give one of them"),
        (["--dims", "0", "--along", "hessian"], "give one of them"),
        (
            ["--along", "downhill"],
            "--along takes random:SEED, filters:SEED, gradient, hessian, pca:RUN, training:FOLDER, A:B or A:B:C; got",
        ),
        (["--along", "training:nowhere"], "takes a folder with checkpoints of a training; got 'nowhere'"),
        (["--along", "filters:0"], "bounce does not say which of its 3 parameters are the weights of one neuron"),
        (["--along", "center:random:1", "--through", "random:2"], "fixes the plane; leave out --through"),
        (["--along", "center:center"], "neither zero nor parallel"),
        (["--along", "pca:nothing"], "nothing"),
        (["--along", "pca"], "--along pca:RUN takes the folder of a run"),
        (["--dims", "0", "--through", "best:"], "best:RUN takes the folder of a run"),
        (["--dims", "0", "--through", "random:x"], "got 'random:x', which is none of these"),
        (
            ["--along", "hessian", "--through", "best"],
            "there is no run of bounce with these options in out/; `landscape optimize",
        ),
    ],
)
def test_what_cannot_be_cut_is_one_line_and_nothing_is_written(run, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gradscape.jobs.scene.best_of_league", lambda env: None)  # the gallery keeps one of bounce
    done = run("slice", "bounce", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())
