"""`gs.report`, `gs.check`, `gs.study`, `gs.pairs`: what each promises."""

from pathlib import Path

import pytest
import torch

import gradscape as gs
from gradscape.landscapes import cost
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.storage.records import read_json
from gradscape.studies import samples


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave results and what is kept for a tolerance in the test's own folder, and time little."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gradscape.studies.own_folder.user_data_path", lambda name: tmp_path / "data" / name)
    for module, names in ((cost, ("MOMENT", "ENOUGH", "WARM_UP")), (samples, ("REPETITION", "LARGEST"))):
        for name in names:
            monkeypatch.setattr(module, name, 0.0)


@pytest.mark.drawn
def test_a_slice_and_its_folder_have_the_same_report_which_is_read_again(tmp_path: Path) -> None:
    cut = gs.slice("branin", (0, 1), resolution=24, out=tmp_path / "cut")
    told = gs.report(cut, points_per_axis=2, out=tmp_path / "told")
    assert told.words == ("smooth with local minima", "gradients follow")
    assert told.profile.losses.notable == 3  # Branin's minima
    assert told.table().loc["Local minima deeper than 1 % of the range", "value"] == "3"
    assert to_json(told) == read_json(tmp_path / "told/report.json")
    assert told.plot()._repr_png_().startswith(b"\x89PNG")
    assert "smooth with local minima" in told._repr_html_()
    before = (tmp_path / "told/report.json").stat().st_mtime_ns
    assert gs.report(tmp_path / "cut", points_per_axis=2, out=tmp_path / "told") == told
    assert (tmp_path / "told/report.json").stat().st_mtime_ns == before
    with pytest.raises(ValueError, match="only in memory"):
        gs.report(gs.Slice(cut.data))


class Bowl(gs.Environment):
    """A bowl whose gradient is wrong where that is asked for."""

    fidelities = {"only": gs.Fidelity("only", dt=0.1, precision="float64")}  # noqa: RUF012 -- of this test alone
    space = gs.ParameterSpace.box(["a", "b"], -1.0, 2.0)
    sign = 1.0

    def _evaluate(self, x: torch.Tensor, *, grad: bool) -> gs.Evaluation:
        return gs.Evaluation.from_results(x.square().sum(dim=1), 2 * self.sign * x if grad else None)


class Hill(Bowl):
    """Gradients that point downhill."""

    sign = -1.0


def test_a_class_is_checked_and_its_findings_are_a_table() -> None:
    passed, failed = gs.check(Bowl), gs.check(Hill(), power="20%")
    assert passed.passed
    assert not failed.passed
    assert (failed.power, failed.share.points) == (0.2, 16)
    table = failed.table()
    assert list(table.index) == [finding.check for finding in failed.findings]
    assert table.loc["gradient", "outcome"] == "fail"
    assert failed.diagnoses[0].cause == "sign"
    assert set(failed.parameter_table()["verdict"]) == {"wrong"}
    assert [one["check"] for one in failed.record()["checks"]] == list(table.index)


def test_keywords_beside_an_environment_are_its_settings() -> None:
    assert gs.check(Bowl(), device="cpu").device == "cpu"
    with pytest.raises(ValueError, match="runs on cpu; got device 'cuda'"):
        gs.check(Bowl(), device="cuda")
