"""Scene options: read from values and from text, refused with what was wanted."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

import pytest

from gradscape.api.scene import spec_of
from gradscape.envs.records import EpisodeOptions
from gradscape.envs.registry import entries, environment_class, make
from gradscape.gallery.paper import read_paper
from gradscape.landscapes.options import NoOptions, added, describe, in_full, read_options, record_options
from gradscape.optim.registry import methods, optimizer_class


@dataclass(frozen=True)
class Options:
    goal: Literal["high", "low"] = "high"
    mu: float = 0.5
    count: int = 3
    rough: bool = False


def read(**given):
    return read_options("scene", Options, given)


def test_text_reads_as_the_value_it_names_and_nothing_given_leaves_the_defaults():
    assert read() == Options()
    assert read_options("plain", NoOptions, {}) == NoOptions()
    assert read(goal="low", mu="0.25", count="7", rough="true") == Options("low", 0.25, 7, True)
    assert read(goal="low", mu=0.25, count=7, rough=True) == Options("low", 0.25, 7, True)
    assert read(rough="False", mu=1) == Options(mu=1.0, rough=False)
    assert isinstance(read(mu=1).mu, float)


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("goal", "sideways", "high|low"),
        ("mu", "slippery", "a number"),
        ("mu", None, "a number"),
        ("count", "many", "a whole number"),
        ("count", "2.5", "a whole number"),
        ("count", 2.5, "a whole number"),
        ("rough", "maybe", "true|false"),
        ("mu", "nan", "a number"),
    ],
)
def test_a_wrong_value_is_refused_with_what_was_wanted(name, value, wanted):
    with pytest.raises(ValueError, match=f"scene option {name} takes {wanted}; got".replace("|", r"\|")) as refusal:
        read(**{name: value})
    assert repr(value) in str(refusal.value)


def test_an_unknown_option_is_refused_with_those_there_are():
    known = "goal=high|low (default high), mu=a number (default 0.5), count=a whole number (default 3)"
    assert describe(Options).startswith(known)
    with pytest.raises(ValueError, match="scene has no option 'wind'; it has goal=high"):
        read(wind=3)
    with pytest.raises(ValueError, match="plain has no option 'wind'; it has none"):
        read_options("plain", NoOptions, {"wind": 3})


def test_an_episodes_horizon_stands_last_and_is_explained():
    @dataclass(frozen=True)
    class Scene(EpisodeOptions):
        """`mu`: friction."""

        mu: float = 0.5

    assert Scene(0.1).mu == 0.1
    assert describe(Scene) == "mu=a number (default 0.5), horizon=a number above 0, at most 8 (default 1.0)"
    said = in_full(Scene)
    assert "\n\n`mu`: friction.\n\n`horizon`: how long an episode lasts" in said
    assert in_full(type("Bare", (Scene,), {"__doc__": "Bare(what dataclasses make up)"})).count("Bare(") == 0
    assert in_full(NoOptions) == "options: none"
    assert read_options("scene", Scene, {"horizon": "0.5"}).count_steps(5) == 2
    assert Scene(horizon=1e-3).count_steps(5) == 1


OPTIONS = {name: environment_class(name).Options for name in entries()} | {
    name: optimizer_class(name).Options for name in methods()
}


def test_every_option_of_every_scene_and_method_is_listed_and_explained() -> None:
    for name, declared in OPTIONS.items():
        said = in_full(declared)
        for option in dataclasses.fields(declared):
            assert f"\n  {option.name}=" in said, name
            assert f"`{option.name}`" in said, f"{name} explains no `{option.name}`"


def test_an_option_that_was_added_later_is_recorded_only_where_it_says_something():
    @dataclass(frozen=True)
    class Later(Options):
        anchors: Literal["still", "swing"] = added("still")

    assert record_options(Later()) == record_options(Options())
    assert record_options(Later(anchors="swing"))["anchors"] == "swing"


def test_presets_are_options_that_their_scenes_have_and_the_paper_s_scenes_have_its():
    for name in read_paper().words:
        scene = environment_class(name)
        read_options(name, scene.Options, scene.preset_options("paper"))
    env = make("fluid", preset="paper", viscosity=5.0, device="cpu")
    assert (env.options.speed, env.options.viscosity, float(env.space.upper[0])) == (0.8, 5.0, 0.8)
    assert spec_of("fluid", {"preset": "paper", "options": ["viscosity=5"]}).make().identity() == env.identity()
    with pytest.raises(ValueError, match="fluid has preset paper; got preset 'printed'"):
        spec_of("fluid", {"preset": "printed"})
