"""Pictures of records: `figure_of` finds the drawing function by the name of the record's class."""

from __future__ import annotations

import io
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

if TYPE_CHECKING:
    from . import style

# The function "module:name" of the package that draws records of a class, imported when one is drawn. It takes the
# record and the keyword `width`.
FIGURES = {
    "Card": "landscapes.draw.figures.multiples:card_figure",
    "Census": "landscapes.draw.figures.multiples:census_figure",
    "CheckReport": "landscapes.draw.figures.check:check_figure",
    "ConvergenceRecord": "landscapes.draw.figures.convergence:convergence_figure",
    "Episode": "landscapes.draw.figures.contact:episode_figure",
    "ExtremesRecord": "landscapes.draw.figures.extremes:extremes_figure",
    "FidelityRecord": "landscapes.draw.figures.accuracy:fidelity_figure",
    "Hessian": "landscapes.draw.figures.hessian:hessian_figure",
    "MixedRecord": "landscapes.draw.figures.accuracy:mixed_figure",
    "ModelRecord": "landscapes.draw.figures.accuracy:model_figure",
    "SymmetryRecord": "landscapes.draw.figures.symmetry:symmetry_figure",
    "UpdatesRecord": "landscapes.draw.figures.updates:updates_figure",
    "SliceComparison": "landscapes.draw.figures.comparison:comparison_figure",
}
_PACKAGE = __name__.partition(".landscapes.")[0]


class Picture(Figure):
    """A figure with its sheet; it draws without a window or global state, and shows in a notebook.

    `settle` lays it out once. It has no layout engine, because `savefig` draws a figure with one twice.
    """

    def __init__(self, sheet: style.Sheet, height: float) -> None:
        super().__init__(figsize=(sheet.width, height), layout="none")  # type: ignore[arg-type] # missing in its stub
        self.sheet = sheet
        self.fitted: dict[
            Text, tuple[str, Callable[[], float]]
        ] = {}  # what is wrapped to how much room there is [inch]
        FigureCanvasAgg(self)

    def _repr_png_(self) -> bytes:
        """Return the PNG that a notebook shows."""
        from .style import DPI

        with io.BytesIO() as raw:
            self.savefig(raw, format="png", dpi=DPI)
            return raw.getvalue()


def figure_of(record: Any, width: float | None = None, **options: Any) -> Picture:
    """Draw a record for a screen, or for a page of a width [mm]; `options` are those of its figure.

    Raises TypeError if records of this class have no figure, ValueError if the page is too narrow or too wide.
    """
    for kind in type(record).__mro__:
        if place := FIGURES.get(kind.__name__):
            module, name = place.split(":")
            draw = getattr(import_module(f"{_PACKAGE}.{module}"), name)
            return cast("Picture", draw(record, width=width, **options))
    raise TypeError(f"a {type(record).__name__} has no figure; these records have one: {', '.join(sorted(FIGURES))}")
