"""`landscape slice --refine` and `--budget`, and what a slice says of what its samples hide."""

import json
from pathlib import Path

import numpy as np
import pytest

import gradscape as gs
from gradscape.gallery.site.page_data import count_numbers
from gradscape.jobs.slice import SliceJob
from gradscape.jobs.watch import Stopped
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.draw.figures.multiples import thumbnail_figure
from gradscape.landscapes.draw.figures.profile import profile_figure
from gradscape.landscapes.objective import Status
from gradscape.landscapes.storage.store import open_slice

from ..command import Run
from ..watches import Stop, Told

REFINED = "slice pinball-2 --dims 0 1 --resolution 33 --refine 5% --json --device cpu --fidelity draft --out"


def foot(figure: object) -> str:
    legends = figure.legends  # type: ignore[attr-defined]
    return "\n".join(text.get_text() for legend in legends for text in legend.get_texts())


def test_a_refined_slice_says_what_was_sampled_and_is_there_the_second_time(run: Run, tmp_path: Path) -> None:
    first = run.ok(*REFINED.split(), "made")
    said = first.json
    assert said["status"]["ok"] + said["status"]["interpolated"] == 33 * 33
    assert said["refinement"]["sampled"] == said["status"]["ok"] == said["episodes"]
    assert "up to 1089 episodes with gradients to compute" in first.stderr
    assert f"{said['episodes']} of 1089 points sampled" in first.stderr
    again = run.json(*REFINED.split(), "made")
    assert (again["episodes"], again["resumed"]) == (0, said["episodes"])
    assert {name: again[name] for name in ("status", "loss", "undersampled")} == {
        name: said[name] for name in ("status", "loss", "undersampled")
    }
    run.refuse(*REFINED.replace("5%", "4%").split(), "made", said="refinement.share: wanted 0.04, found 0.05")
    plain = run(*REFINED.replace("--refine 5%", "--force").split(), "made")
    assert plain.json["refinement"] is None
    assert sorted(path.name for path in (tmp_path / "made").iterdir()) == [
        "landscape.png", "slice.zarr.zip", "summary.json",
    ]  # fmt: skip


def test_a_job_that_is_stopped_keeps_what_it_has_and_draws_it(tmp_path: Path) -> None:
    from gradscape.envs.registry import make
    from gradscape.jobs.scene import plane_through
    from gradscape.landscapes.sampling.refine import Refinement

    env = make("pinball-2", fidelity="draft", device="cpu")
    plane = plane_through(env, (0, 1), through="center", window=None, resolution=33)

    def job(name: str) -> SliceJob:
        return SliceJob.of(env, plane, command="", out=tmp_path / name, refinement=Refinement(0.05))

    whole = job("one").run()
    with pytest.raises(Stopped, match="of 1089 points are kept"):
        job("two").run(Stop(100))
    assert (tmp_path / "two" / "landscape.png").exists()
    kept, patient = job("two").kept(), Told()
    rest = job("two").run(patient)
    assert f"{rest.resumed} of 1089 points are kept" in kept
    assert f"up to {1089 - rest.resumed} episodes with gradients to compute, {rest.resumed} are done" in "".join(
        patient.lines
    )
    assert rest.resumed > 0
    assert rest.episodes + rest.resumed == whole.episodes
    one, two = (open_slice(tmp_path / name) for name in ("one", "two"))
    for name in ("loss", "grad", "status", "interpolated"):
        assert one[name].to_numpy().tobytes() == two[name].to_numpy().tobytes()
    assert one.attrs["unresolved"] == two.attrs["unresolved"]


@pytest.mark.drawn
def test_pictures_draw_each_sample_as_large_as_what_it_stands_for(tmp_path: Path) -> None:
    cut = gs.slice("branin", (0, 1), resolution=65, refine=0.02, out=tmp_path / "map")
    picture = landscape_figure(cut.data)
    (mesh,) = (one for one in picture.axes[0].collections if one.get_gid() is None)
    colours = np.ma.filled(mesh.get_array(), np.nan).reshape(65, 65)
    assert np.isfinite(colours).all()
    assert set(np.unique(colours)) == set(np.unique(cut.data["loss"].to_numpy()[cut.data["status"] == Status.OK]))
    assert f"65 \N{MULTIPLICATION SIGN} 65 points, {int((cut.data['status'] == 1).sum())} sampled" in str(
        picture.get_suptitle()
    )
    assert "interpolated points: 95 % within" in foot(picture)
    thumbnail_figure(cut.data)
    line = gs.slice("branin", (0,), resolution=257, refine=0.02, out=tmp_path / "line")
    (drawn, *_) = profile_figure(line.data).axes[0].get_lines()
    assert len(drawn.get_xdata()) == int((line.data["status"] == Status.OK).sum()) < 257


@pytest.mark.drawn
def test_a_slice_says_at_its_foot_and_on_its_page_what_it_hides(tmp_path: Path) -> None:
    cut = gs.slice("pinball-2", (0, 1), resolution=12, fidelity="draft", device="cpu", out=tmp_path / "cut")
    numbers = count_numbers(cut.data)
    assert numbers.undersampled is not None
    assert (numbers.undersampled["value"] or 0) > 0.1
    said = f"undersampled cells: {100 * (numbers.undersampled['value'] or 0):.0f} % ("
    assert said in foot(landscape_figure(cut.data))
    older = cut.data.drop_attrs(deep=False).assign_attrs(
        {name: value for name, value in cut.data.attrs.items() if name != "unresolved"}
    )
    assert "undersampled" not in foot(landscape_figure(older))
    assert count_numbers(older).undersampled is None
    assert to_json(cut.report(points=2).undersampled) == json.loads(cut.data.attrs["unresolved"])
    looked = gs.Slice(older, None, cut.remake).report(points=2).undersampled
    assert looked is not None
    assert looked.share.value > 0.1


def test_runs_lie_over_what_the_picture_of_a_refined_slice_shows(tmp_path: Path) -> None:
    cut = gs.slice("branin", (0, 1), resolution=65, refine=0.02, out=tmp_path / "map")
    run = gs.optimize("branin", "random", budget=30, seed=0, out=tmp_path / "run")
    beneath = gs.overlay(cut, run).runs[0]["beneath"].to_numpy()
    assert np.isin(beneath, cut.data["loss"].to_numpy()).all()
