"""The parts that scenes name of their models: options there are, that change something."""

import pytest
from torch import Tensor

from gradscape.envs.records import ModelPart
from gradscape.envs.registry import BUILTIN, environment_class, make

PARTS = [(entry.name, part) for entry in BUILTIN for part in environment_class(entry.name).model_parts]


@pytest.mark.parametrize(("scene", "part"), PARTS or [("branin", None)])
def test_the_options_of_a_part_are_taken_and_change_the_scene(scene: str, part: ModelPart | None) -> None:
    if part is None:
        pytest.skip("no scene names parts of its model")
    plain, changed = make(scene, device="cpu"), make(scene, device="cpu", **part.options)
    assert changed.options != plain.options
    assert part.name
    assert part.change


@pytest.mark.parametrize("scene", [entry.name for entry in BUILTIN])
def test_the_parts_of_a_scene_have_names_and_options_of_their_own(scene: str) -> None:
    parts = environment_class(scene).model_parts
    assert len({part.name for part in parts}) == len(parts)
    assert len({tuple(sorted(part.options.items())) for part in parts}) == len(parts)


@pytest.mark.parametrize("option", [{"loss": "mesh"}, {"horizon": 0.5}])
def test_a_target_that_a_demonstration_makes_is_that_of_the_default_model(option: dict[str, object]) -> None:
    """A part that is changed moves losses by the motion alone, not by the target as well."""

    def target(**options: object) -> Tensor:
        found: Tensor = make("swing-velocity", device="cpu", **options)._target  # type: ignore[attr-defined]
        return found

    assert target(**option).equal(target())
