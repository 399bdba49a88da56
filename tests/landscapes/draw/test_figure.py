"""Figures by dispatch: every class with a figure has a function that draws it."""

from __future__ import annotations

import inspect
from importlib import import_module

import pytest

from gradscape.landscapes.draw.figure import FIGURES, figure_of


@pytest.mark.parametrize("kind", FIGURES)
def test_the_figure_of_a_class_is_drawn_from_a_record_of_that_class(kind: str) -> None:
    module, name = FIGURES[kind].split(":")
    record, *options = inspect.signature(getattr(import_module(f"gradscape.{module}"), name)).parameters.values()
    assert record.annotation == kind
    assert any(option.name == "width" and option.kind is option.KEYWORD_ONLY for option in options)


def test_what_has_no_figure_is_named() -> None:
    with pytest.raises(TypeError, match="int has no figure"):
        figure_of(3)
