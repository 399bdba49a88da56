"""`landscape study extremes` and what `landscape envs NAME` says of it: what they leave, say and refuse."""

from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from gradscape.envs import registry
from gradscape.envs.base import Environment, Fidelity, Work
from gradscape.landscapes.convert import from_json
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.records import read_json, write_record
from gradscape.studies.extremes import ExtremesRecord

from ..command import Run

TURN = ["study", "extremes", "stepping", "--points", "4", "--device", "cpu", "--out", "turned"]


class Stepping(Environment):
    """A bowl that fails beyond a step of 0.35 s, or beyond three times its box; in float32 beyond 0.25 s."""

    name = "stepping"
    fidelities: ClassVar[dict[str, Fidelity]] = {
        "standard": Fidelity("standard", dt=0.1),
        "reference": Fidelity("reference", dt=0.01, precision="float64"),
    }
    beyond_box = True
    space = ParameterSpace.box(["x0", "x1"], -1.0, 1.0)

    def work(self) -> Work:
        return Work(max(1, round(10 / self.fidelity.dt)), "step")

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        loss = x.square().sum(dim=1) + self.fidelity.dt**2
        loss[x.abs().amax(dim=1) > 3] = torch.inf
        if self.fidelity.dt > (0.25 if self.fidelity.precision == "float32" else 0.35):
            loss[:] = torch.nan
        return Evaluation.from_results(loss, 2 * x if grad else None)


@pytest.fixture(autouse=True)
def own_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("gradscape.studies.own_folder.user_data_path", lambda name: tmp_path / "data" / name)
    monkeypatch.setitem(registry.entries(), "stepping", registry.Entry("stepping", f"{__name__}:Stepping"))
    return tmp_path / "data"


@pytest.mark.drawn
def test_a_study_leaves_a_record_a_picture_and_the_margin(run: Run, tmp_path: Path) -> None:
    assert "stability: not measured; `landscape study extremes stepping` measures it" in run("envs stepping").stdout
    done = run.ok(*TURN, "--grid", "3", "--json", "--figure-width-mm", "85")
    report = done.json
    assert {**read_json(tmp_path / "turned/extremes.json"), "folder": "turned"} == report
    assert (tmp_path / "turned/extremes.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "turned/extremes-85mm.pdf").read_bytes().startswith(b"%PDF")
    assert report["provenance"]["command"] == report["command"]
    limits = {(one["setting"], one["precision"]): one for one in report["limits"]}
    for (setting, precision), truth in {
        ("dt", "float32"): 0.25, ("dt", "float64"): 0.35, ("box", "float32"): 3.0, ("box", "float64"): 3.0,
    }.items():  # fmt: skip
        limit = limits[setting, precision]
        assert limit["stable"] <= truth <= limit["failed"]
        assert limit["beyond"] == "NONFINITE"
    assert "settings to measure at 4 points" in done.stderr
    said = run("envs stepping").stdout
    share = 0.1 / limits["dt", "float32"]["stable"]
    assert f"standard's step is {share:.2g} of the largest stable one" in said
    assert "float64; warp on cpu, 4 points" in said


def test_envs_says_where_a_margin_is_of_another_model_and_of_other_options_nothing(run: Run, own_data: Path) -> None:
    run.ok(*TURN, "--settings", "dt", "--precisions", "float32")
    (path,) = own_data.rglob("*.json")
    record = read_json(path)
    write_record(path, {**record, "identity": {**record["identity"], "model_version": 0}})
    assert "with stepping model 0; this is model 1" in run("envs stepping").stdout
    write_record(path, {**record, "identity": {**record["identity"], "options": {"soft": 1.0}}})
    assert "stability: not measured" in run("envs stepping").stdout
    path.write_text("{}")
    run.refuse("envs stepping", said=path.name)


def test_shipped_extremes_are_found_where_nothing_of_the_users_own_is(
    run: Run, tmp_path: Path, own_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(*TURN, "--settings", "dt", "--precisions", "float32")
    (path,) = own_data.rglob("*.json")
    shipped = tmp_path / "package" / "data" / "studies" / "stepping-cpu.extremes.json"
    shipped.parent.mkdir(parents=True)
    path.rename(shipped)
    monkeypatch.setattr("gradscape.studies.kept.resources.files", lambda package: tmp_path / "package")
    assert "of the largest stable one" in run("envs stepping").stdout


def test_the_table_says_what_is_beyond(run: Run) -> None:
    said = run(*TURN, "--settings", "dt,box", width=200).stdout
    assert "stepping: standard on cpu, 4 points, compared with reference (accurate: within 10% of the spread)" in said
    assert "then NONFINITE" in " ".join(said.split())


@pytest.mark.drawn
def test_a_map_shows_each_outcome_the_boundary_and_the_base(run: Run, tmp_path: Path) -> None:
    run(*TURN, "--grid", "4")
    found = from_json(ExtremesRecord, read_json(tmp_path / "turned/extremes.json"))
    picture = found.plot()
    maps = [ax for ax in picture.axes if ax.get_title().endswith("dt against box")]
    assert len(maps) == len(found.maps) == 2
    for ax, one in zip(maps, found.maps, strict=True):
        drawn: set[Any] = {patch.get_gid() for patch in ax.patches}
        assert drawn - {None} == {cell.outcome for cell in one.cells}
        (line,) = (line for line in ax.lines if line.get_gid() == "limit of stability, bisected")
        assert sorted(line.get_ydata()) == sorted(y for y, _, _ in one.boundary)
        (star,) = (line for line in ax.lines if line.get_gid() == "base")
        assert (star.get_xdata()[0], star.get_ydata()[0]) == (0.1, 1.0)
