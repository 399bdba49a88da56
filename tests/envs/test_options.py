"""Scene options: read from values and from text, refused with what was wanted."""

from dataclasses import dataclass
from typing import Literal

import pytest

from gradscape.envs.options import NoOptions, describe, read_options


@dataclass(frozen=True)
class Options:
    goal: Literal["high", "low"] = "high"
    mu: float = 0.5
    count: int = 3
    rough: bool = False


def read(**given):
    return read_options("scene", Options, given)


def test_nothing_given_leaves_the_defaults():
    assert read() == Options()
    assert read_options("plain", NoOptions, {}) == NoOptions()


def test_text_reads_as_the_value_it_names():
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
    with pytest.raises(ValueError, match="scene has no option 'wind'; it has goal=high"):
        read(wind=3)
    with pytest.raises(ValueError, match="plain has no option 'wind'; it has none"):
        read_options("plain", NoOptions, {"wind": 3})


def test_a_description_names_every_option_with_its_default():
    line = describe(Options)
    for part in ("goal=high|low (default high)", "mu=a number (default 0.5)", "count=a whole number (default 3)"):
        assert part in line
