"""Every figure function: shown in a notebook, drawn for print at a journal's widths, saved by its ending."""

import inspect
import itertools
import json
import pkgutil
import re
from collections.abc import Callable
from functools import cache, partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib import rcParams
from matplotlib.text import Text

from gradscape.landscapes import draw
from gradscape.landscapes.draw.figure import FIGURES as DISPATCHED
from gradscape.landscapes.draw.figure import figure_of
from gradscape.landscapes.draw.figures import page
from gradscape.landscapes.draw.figures.contact import Caption
from gradscape.landscapes.draw.figures.contour import landscape_figure
from gradscape.landscapes.draw.figures.multiples import CompanionSlice, Landscape, thumbnail_figure
from gradscape.landscapes.draw.figures.profile import profile_figure
from gradscape.landscapes.draw.figures.sweep import Scales
from gradscape.landscapes.episode import Episode, Part, View
from gradscape.landscapes.measures import gradient_quality as gradients
from gradscape.landscapes.measures.slice_comparison import SliceComparison, compare_slices
from gradscape.landscapes.objective import Status
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.storage.files import print_width
from gradscape.optim.registry import methods

from ....made_studies import fidelities, study
from ...test_overlay import LAID, SLICE
from .records import card, census, checked, convergence, extremes, hessian, league, mixed, symmetry, updates
from .test_contour import BOUNCES, DATASET, LINE, Bowl, plane
from .test_search import race, table
from .test_sweep import SWEEP

pytestmark = pytest.mark.slow

INCH, WIDTHS = 25.4, (85.0, 170.0)
COMMAND = "landscape slice bowl --dims speed lift --resolution 16 --fidelity standard --through example:somewhere"


def dated(dataset):
    """Give a slice the provenance that one from the command has."""
    return dataset.assign_attrs(provenance=json.dumps({"created": "2026-11-21", "command": COMMAND}))


PLANE, LONG = dated(DATASET), dated(LINE)


def quality(dataset):
    flat = plane(*dataset["loss"].shape[::-1], dims=("speed", "lift")[: dataset["loss"].ndim])
    places = gradients.subgrid(flat, 4 if flat.rank == 2 else 16)
    steps, smooth = gradients.compare_differences(Bowl(), flat, places), gradients.smoothed_slopes(Bowl(), flat, places)
    return dataset, gradients.GradientQuality(steps, gradients.compare_samples(dataset), smooth)


SHIFTED = DATASET.assign(
    loss=DATASET["loss"].copy(data=np.roll(DATASET["loss"], 1)),
    status=DATASET["status"].copy(data=np.roll(DATASET["status"], 1)),
)
FAILED = DATASET.assign(loss=DATASET["loss"] * np.nan, status=DATASET["status"] * 0 + Status.NONFINITE)


def compared(one, other) -> SliceComparison:
    """Compare two slices, of which one is of other options, many of them."""
    options = {f"the friction of wall number {number}": 0.1 * number for number in range(8)}
    identity = json.loads(other.attrs["identity"]) | {"objective": "bowl of another engine", "options": options}
    return compare_slices(one, other.assign_attrs(identity=json.dumps(identity)), command=COMMAND)


EPISODE = Episode(
    torch.arange(6) / 10, {}, {}, (Part("sphere", "rubber", torch.zeros(6, 1, 3), (0.3,)),),
    View((-1.0,) * 3, (1.0,) * 3, ground=None),
)  # fmt: skip
CAPTION = Caption(
    "plasticine · reference", "loss 1.2345 m", "best:out/race", {f"tool {n} x": "−0.25 m" for n in range(30)},
    "episode.json", COMMAND,
)  # fmt: skip
PARTS = {f"the walls' friction, number {number}": 0.01 * 1.5**number for number in range(12)}
AIM = CompanionSlice("example:aim", PLANE["loss"].to_numpy())
CENTER, RANDOM = (CompanionSlice(name, LONG["loss"].to_numpy()) for name in ("center", "random:3"))
CUTS = [CompanionSlice("center", np.full((4, 4), np.nan)), CompanionSlice("random:3", np.arange(16.0).reshape(4, 4))]
HUNG = [
    Landscape("swing-velocity", "smooth with local minima 100 %, discontinuous 100 %, large flat regions 100 %", PLANE)
]
RACE = race(tuple(methods()), provenance=json.dumps({"created": "2026-11-21", "command": COMMAND}))
MIXED = mixed()
CHOSEN = {"draft": MIXED.variants[-1].name, "standard": MIXED.variants[10].name}
FIGURES: dict[str, list[Callable[[Callable[..., page.Picture]], page.Picture]]] = {
    "landscape_figure": [lambda draw: draw(PLANE), lambda draw: draw(dated(sample(Bowl(), plane(9, 9), gradients=0)))],
    "profile_figure": [lambda draw: draw(LONG, events={"bounces": BOUNCES})],
    "run_figure": [
        lambda draw: draw(
            table([9.0, 3.0, np.nan, 0.01], [0, 1, 2, 3]).assign_attrs(provenance=json.dumps({"command": COMMAND}))
        )
    ],
    "quality_figure": [lambda draw: draw(*quality(PLANE)), lambda draw: draw(*quality(LONG))],
    "overlay_figure": [lambda draw: draw(dated(SLICE), LAID), lambda draw: draw(dated(SLICE), LAID[:1] * 12)],
    "race_figure": [lambda draw: draw(RACE), lambda draw: draw(RACE.assign(unsuccessful=RACE["unsuccessful"] + 2))],
    "comparison_figure": [
        lambda draw: draw(compared(DATASET, SHIFTED)),
        lambda draw: draw(compared(LINE, LINE.assign(loss=1.2 * LINE["loss"]))),
        lambda draw: draw(compared(DATASET, FAILED)),
    ],
    "surface_figure": [lambda draw: draw(dated(SLICE), LAID), lambda draw: draw(PLANE)],
    "fidelity_figure": [lambda draw: draw(fidelities()), lambda draw: draw(MIXED, chosen=CHOSEN)],
    "convergence_figure": [lambda draw: draw(convergence())],
    "model_figure": [lambda draw: draw(study(PARTS, failing=True))],
    "companions_figure": [lambda draw: draw([AIM, *CUTS], PLANE), lambda draw: draw([CENTER, RANDOM], LONG)],
    "card_figure": [lambda draw: draw(card())],
    "census_figure": [lambda draw: draw(census())],
    "check_figure": [lambda draw: draw(checked()), lambda draw: draw(checked((), kinds={}))],
    "hessian_figure": [
        lambda draw: draw(hessian(3, 3)),
        lambda draw: draw(hessian(40, 40)),
        lambda draw: draw(hessian(300, 10)),
    ],
    "extremes_figure": [lambda draw: draw(extremes())],
    "symmetry_figure": [lambda draw: draw(symmetry())],
    "updates_figure": [lambda draw: draw(updates())],
    "league_figure": [lambda draw: draw(league())],
    "frame_figure": [lambda draw: draw(SWEEP, 1, Scales.of(SWEEP))],
    "episode_figure": [lambda draw: draw(EPISODE, caption=CAPTION)],
    "wall_figure": [lambda draw: draw(HUNG * 16), lambda draw: draw(HUNG)],
    "thumbnail_figure": [lambda draw: draw(DATASET)],
}
EACH = [
    pytest.param(name, make, id=f"{name}-{number}") for name in FIGURES for number, make in enumerate(FIGURES[name])
]


@cache
def functions() -> dict[str, Callable[..., page.Picture]]:
    """Return every figure function there is, by its name."""
    modules = [import_module(one.name) for one in pkgutil.walk_packages(draw.__path__, f"{draw.__name__}.")]
    every = {name: made for module in modules for name, made in vars(module).items()}
    return {name: made for name, made in every.items() if name.endswith("_figure") and not name.startswith("_")}


def test_every_figure_function_is_held_to_this() -> None:
    assert set(functions()) == {*FIGURES, "mixed_figure"}  # which is that of a fidelity study, with other marks


@pytest.mark.parametrize("kind", DISPATCHED)
def test_the_figure_of_a_class_is_drawn_from_a_record_of_that_class(kind: str) -> None:
    module, name = DISPATCHED[kind].split(":")
    record, *options = inspect.signature(getattr(import_module(f"gradscape.{module}"), name)).parameters.values()
    assert record.annotation == kind
    assert any(option.name == "width" and option.kind is option.KEYWORD_ONLY for option in options)


def test_what_has_no_figure_is_named() -> None:
    with pytest.raises(TypeError, match="int has no figure"):
        figure_of(3)


@pytest.mark.parametrize("kind", ["png", "pdf", "svg"])
def test_a_picture_is_drawn_once_where_it_is_saved(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture, drawn, draw_ = landscape_figure(PLANE), [], page.Picture.draw
    monkeypatch.setattr(page.Picture, "draw", lambda self, renderer: drawn.append(draw_(self, renderer)))
    page.save(picture, tmp_path / f"picture.{kind}")
    assert len(drawn) == 1


def test_a_settled_panel_is_measured_anew() -> None:
    ax = profile_figure(LONG).axes[0]
    before = ax.get_tightbbox().width
    ax.set_yticks([0.0], ["a much longer name than any number"])
    assert ax.get_tightbbox().width > before + 10


def test_a_notebook_shows_a_picture() -> None:
    assert thumbnail_figure(DATASET)._repr_png_().startswith(b"\x89PNG")


def seen(picture: page.Picture) -> list[Text]:
    """Return the texts that are there to read: not those of hidden panels, and of ticks those along the axis."""
    hidden = set()
    for ax in picture.axes:
        low, high = ax.get_window_extent().min - 1, ax.get_window_extent().max + 1
        for axis, ticks in enumerate((ax.get_xticklabels(which="both"), ax.get_yticklabels(which="both"))):
            middles = [np.mean(text.get_window_extent().get_points(), axis=0)[axis] for text in ticks]
            hidden |= {
                text for text, at in zip(ticks, middles, strict=True)
                if not ax.axison or not low[axis] <= at <= high[axis]
            }  # fmt: skip
        hidden |= set(ax.findobj(Text)) if not ax.get_visible() else set()
    found = [text for text in picture.findobj(Text) if text not in hidden]
    return [text for text in found if text.get_text().strip() and text.get_visible()]


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize(("name", "make"), EACH)
def test_in_print_all_is_legible_on_the_page_and_apart(
    name: str, make: Callable[..., page.Picture], width: float, tmp_path: Path
) -> None:
    picture = make(partial(functions()[name], width=width))
    assert isinstance(picture, page.Picture)  # which a notebook shows
    picture.canvas.draw()
    assert picture.get_size_inches()[0] * INCH == pytest.approx(width, abs=0.01)
    assert picture.get_size_inches()[1] * INCH < 240, "higher than a page"
    texts = seen(picture)
    for text in texts:
        assert text.get_fontsize() >= 6, text
        assert "$" not in text.get_text(), "its exponents are smaller"
    boxes = [Text.get_window_extent(text) for text in texts]  # without the line that leads to it
    for text, box in zip(texts, boxes, strict=True):
        assert min(box.x0, box.y0) >= -0.5, text
        assert box.x1 <= picture.bbox.x1 + 0.5, text
        assert box.y1 <= picture.bbox.y1 + 0.5, text
    for (text, box), (other, another) in itertools.combinations(zip(texts, boxes, strict=True), 2):
        apart = box.x1 <= another.x0 or another.x1 <= box.x0 or box.y1 <= another.y0 or another.y1 <= box.y0
        assert apart or text.get_rotation() % 90 or other.get_rotation() % 90, (text, other)
    if width > min(WIDTHS):
        return  # fonts and width of the file are those of the picture, whichever it is
    page.save(picture, tmp_path / "picture.pdf")
    raw = (tmp_path / "picture.pdf").read_bytes()
    left, _, right, _ = map(float, re.search(rb"/MediaBox \[ ([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) \]", raw).groups())
    assert (right - left) / 72 * INCH == pytest.approx(width, abs=0.5)
    assert b"/Type3" not in raw
    assert (b"/FontFile2" in raw) == bool(texts)


def test_panels_stand_one_below_the_other_in_a_column_and_side_by_side_on_a_page() -> None:
    for name in ("landscape_figure", "overlay_figure", "race_figure"):
        make = FIGURES[name][0]
        column, whole = (make(partial(functions()[name], width=width)).axes[:2] for width in WIDTHS)
        assert column[0].get_position().y0 > column[1].get_position().y1
        assert whole[0].get_position().x1 < whole[1].get_position().x0


def test_only_known_endings_are_written_and_nothing_is_left_of_others(tmp_path: Path) -> None:
    picture = thumbnail_figure(DATASET)
    with pytest.raises(ValueError, match=r"a picture is saved as \.png, \.pdf or \.svg; got 'a\.jpeg'"):
        page.save(picture, tmp_path / "a.jpeg")
    assert not list(tmp_path.iterdir())


def test_equal_pictures_are_equal_files_and_settings_stay_as_they_were(tmp_path: Path) -> None:
    before = dict(rcParams)
    for kind in ("png", "pdf", "svg"):
        for name in ("one", "two"):
            page.save(profile_figure(LONG, width=85), tmp_path / f"{name}.{kind}")
        assert (tmp_path / f"one.{kind}").read_bytes() == (tmp_path / f"two.{kind}").read_bytes()
    assert dict(rcParams) == before
    assert re.search(r'<svg [^>]*width="240\.9\d*pt"', (tmp_path / "one.svg").read_text())


WIDE = "a picture for print is 80 to 400 mm wide; got"
EVENTS = r"'bounces' needs 60 whole numbers.*float64 of shape \(3,\)"
REFUSED: list[tuple[str, Callable[[Callable[..., page.Picture]], page.Picture], str]] = [
    ("landscape_figure", lambda draw: draw(LINE), "rank 1, so use profile_figure"),
    ("profile_figure", lambda draw: draw(DATASET), "rank 2, so use landscape_figure"),
    ("profile_figure", lambda draw: draw(LINE, events={"bounces": np.ones(3)}), EVENTS),
    ("surface_figure", lambda draw: draw(LINE), "a slice of rank 1"),
    ("wall_figure", lambda draw: draw([]), "got none"),
    ("episode_figure", lambda draw: draw(Episode(torch.zeros(1), {})), "give Episode its `parts`"),
    ("landscape_figure", lambda draw: draw(PLANE, width=20.0), WIDE),
    ("landscape_figure", lambda draw: draw(PLANE, width=1000.0), WIDE),
    ("landscape_figure", lambda draw: draw(PLANE, width=float("nan")), WIDE),
]


@pytest.mark.parametrize(("name", "make", "why"), REFUSED)
def test_what_cannot_be_drawn_is_refused(name: str, make: Callable[..., page.Picture], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        make(functions()[name])


@pytest.mark.slow
def test_prints_are_named_by_their_width_and_those_there_are_drawn_anew(tmp_path: Path) -> None:
    drawn = []

    def draw_(width: float) -> page.Picture:
        drawn.append(width)
        return thumbnail_figure(DATASET, width=width)

    picture = tmp_path / "landscape.png"
    assert page.save_prints(draw_, picture, [85.0]) == ["landscape-85mm.pdf", "landscape-85mm.svg"]
    names = page.save_prints(draw_, picture, [170.0])
    assert drawn == [85.0, 85.0, 170.0]
    assert sorted(names) == sorted(file.name for file in tmp_path.iterdir())
    assert [print_width(name, "landscape.png") for name in names] == [85.0, 85.0, 170.0, 170.0]
    assert print_width("landscape-notes.pdf", "landscape.png") is None


def test_a_text_is_wrapped_by_its_width() -> None:
    for width in (1.0, 2.5, 6.0):
        lines = page.wrap_text(COMMAND, width, 7.0, lines=3).split("\n")
        assert max(page.text_width(line, 7.0) for line in lines) <= width
        assert len(lines) <= 3
    assert page.wrap_text("short", 6.0, 7.0) == "short"
