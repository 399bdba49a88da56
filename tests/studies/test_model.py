"""`study model`: what it finds of parts whose effect and price are known."""

from pathlib import Path
from typing import Any

import pytest
import torch

from gradscape.jobs.scene import SceneSpec
from gradscape.jobs.study import StudyJob
from gradscape.landscapes import cost
from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.storage.records import read_json
from gradscape.studies import samples
from gradscape.studies.model import Effect, MeasuredPart, ModelRecord, Price

from ..command import leave_blank
from ..parted import CLOCK, Parted


def study(folder: Path, **options: Any) -> ModelRecord:
    """Make a study by the clock of the scene, in few rounds and without its picture."""
    Parted.chance.manual_seed(0)
    with pytest.MonkeyPatch.context() as patch:
        for module in (samples, cost):
            patch.setattr(module, "time", CLOCK)
        for name, value in (("MIN_ROUNDS", 3), ("MIN_SECONDS", 0.0), ("BATCH_SECONDS", 0.0), ("RESAMPLES", 99)):
            patch.setattr(samples, name, value)
        leave_blank(patch.setattr)
        found = StudyJob.open("model", SceneSpec(Parted, options=options), out=folder).run()
        assert isinstance(found, ModelRecord)
        return found


def by_name(found: ModelRecord) -> dict[str, MeasuredPart]:
    return {part.name: part for part in found.parts}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return where the study of the scene as it is lies."""
    path = tmp_path_factory.mktemp("study")
    study(path)
    return path


@pytest.fixture(scope="module")
def found(folder: Path) -> ModelRecord:
    """Return that study."""
    return from_json(ModelRecord, read_json(folder / "model.json"))


@pytest.mark.parametrize(
    ("name", "effect", "price"),
    [
        ("wind", Effect.ORDER, Price.NOTHING),
        ("offset", Effect.LOSSES, Price.NOTHING),
        ("paint", Effect.NOTHING, Price.SAVES),
        ("slope", Effect.GRADIENTS, Price.NOTHING),
        ("tough glass", Effect.FAILURE, Price.NOTHING),
        ("gust", Effect.LOSSES, Price.COSTS),
    ],
)
def test_each_part_is_judged_by_what_it_does(name: str, effect: Effect, price: Price, found: ModelRecord) -> None:
    part = by_name(found)[name]
    assert (part.effect, part.price) == (effect, price)
    assert part.verdict == f"{effect}; {price}"


def test_errors_and_times_are_those_of_the_parts(found: ModelRecord) -> None:
    x, parts = Parted.space.sobol(64, seed=0), by_name(found)
    offset, wind = parts["offset"].comparison, parts["wind"].comparison
    assert offset.loss_error.median.value == pytest.approx(1.0)
    assert offset.loss_error.p95.value == pytest.approx(1.0)
    assert (offset.spearman.value, offset.gradient.cosine.value) == (pytest.approx(1.0), pytest.approx(1.0))
    blown = (2 * torch.sin(9 * x[:, 0])).abs()
    assert wind.loss_error.p95.value == pytest.approx(float(blown.quantile(0.95, interpolation="higher")))
    assert parts["slope"].comparison.gradient.relative_error.value == pytest.approx(0.5)
    assert parts["tough glass"].comparison.diverged == pytest.approx(float((x[:, 0] > 0.5).double().mean()))
    for name, ratio in (("paint", 0.5), ("gust", 3.0), ("offset", 1.0)):
        assert parts[name].cost.value == pytest.approx(ratio)
        assert parts[name].cost_forward.value == pytest.approx(ratio)
    assert (found.seconds.forward, found.seconds.with_gradient) == (pytest.approx(2e-3), pytest.approx(4e-3))


def test_missing_parts_stand_apart_and_refused_ones_say_why(found: ModelRecord) -> None:
    assert [part.name for part in found.missing] == ["gust"]
    assert "gust" not in [part.name for part in found.present]
    why = {refused.name: refused.why for refused in found.refused}
    motor = why.pop("motor")
    assert "points where it was tried: RuntimeError: the engine gives up" in motor
    assert why == {"tank": "parted needs its tank", "as it is": "the full model already has the options of 'wind'"}


def test_a_part_below_the_noise_moves_nothing(tmp_path: Path, found: ModelRecord) -> None:
    """The scene's repeats differ by up to 8: the constant is lost among them, the gust but for its gradients."""
    noisy = study(tmp_path, noise=8.0)
    assert found.noise.largest < 1e-6 < 5.0 < noisy.noise.largest <= 8.0 + 1e-6
    assert [by_name(noisy)[name].effect for name in ("offset", "gust")] == [Effect.NOTHING, Effect.GRADIENTS]
    assert [by_name(found)[name].effect for name in ("offset", "gust")] == [Effect.LOSSES, Effect.LOSSES]


def test_options_of_the_full_model_are_kept_where_a_part_changes_others(tmp_path: Path) -> None:
    calm = study(tmp_path, wind=False)
    assert calm.identity["options"]["wind"] is False
    assert {refused.name for refused in calm.refused} == {"wind", "tank", "motor"}
    assert by_name(calm)["as it is"].effect == Effect.ORDER  # it brings the wind back


def test_the_table_has_a_row_for_each_part_and_the_record_is_what_is_read(folder: Path, found: ModelRecord) -> None:
    assert to_json(found) == read_json(folder / "model.json")
    table = found.table()
    assert table.index.tolist() == [part.name for part in (*found.present, *found.missing)]
    assert table.loc["paint", "price"] == "saves time"
