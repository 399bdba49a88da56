"""The parts that scenes name of their models: options there are, that change something."""

import pytest
from torch import Tensor

from gradscape.envs.registry import BUILTIN, environment_class, make


@pytest.mark.slow
def test_the_parts_of_a_scene_have_names_and_options_of_their_own_that_it_takes() -> None:
    for scene in (entry.name for entry in BUILTIN):
        parts = environment_class(scene).model_parts
        assert len({part.name for part in parts}) == len(parts), scene
        made = [make(scene, device="cpu", **options).options for options in ({}, *(part.options for part in parts))]
        assert all(one != other for number, one in enumerate(made) for other in made[:number]), scene
        assert all(part.name and part.change for part in parts), scene


@pytest.mark.parametrize("option", [{"loss": "mesh"}, {"horizon": 0.5}])
def test_a_target_that_a_demonstration_makes_is_that_of_the_default_model(option: dict[str, object]) -> None:
    """A part that is changed moves losses by the motion alone, not by the target as well."""

    def target(**options: object) -> Tensor:
        found: Tensor = make("swing-velocity", device="cpu", **options)._target  # type: ignore[arg-type, attr-defined]
        return found

    assert target(**option).equal(target())
