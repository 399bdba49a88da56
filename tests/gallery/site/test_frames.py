"""What a frame costs while the map moves and the surface turns: it does not go with the size of the slice."""

from collections.abc import Callable
from typing import Any

import pytest

from .browsing import DRAWN, pixels

Visit = Callable[..., Any]


COUNT = """() => {
    window.setTimeout = () => 0; // so that it never rests
    window.work = {};
    const count = (name, size = 1) => { work[name] = (work[name] || 0) + size; };
    const pens = CanvasRenderingContext2D.prototype;
    for (const name of Object.getOwnPropertyNames(pens)) {
        const of = Object.getOwnPropertyDescriptor(pens, name);
        if (typeof of.value !== "function") continue;
        pens[name] = function (...given) { count(name); return of.value.apply(this, given); };
    }
    const sizes = HTMLCanvasElement.prototype, wide = Object.getOwnPropertyDescriptor(sizes, "width");
    Object.defineProperty(sizes, "width", { ...wide, set(value) { count("resized"); wide.set.call(this, value); } });
    for (const name of ["atob", "getComputedStyle"]) {
        const plain = window[name];
        window[name] = (...given) => { count(name); return plain(...given); };
    }
    const construct = (kind, given) => { count("arrays"); return new kind(...given); };
    for (const name of ["Float32Array", "Uint32Array", "Uint8Array", "Uint8ClampedArray", "ImageData"]) {
        window[name] = new Proxy(window[name], { construct });
    }
}"""
NEVER = {"resized", "atob", "getComputedStyle", "arrays", "createImageData", "createPattern", "getImageData"}


def work(page: Any, move: str, frames: int = 12) -> dict[str, int]:
    """Return how often what costs something is called in one frame, the same in each of several."""
    page.evaluate(DRAWN)
    page.evaluate(move, 0)
    page.evaluate(DRAWN)  # what is made once is there
    page.evaluate("work = {}")
    page.evaluate(
        """async ([move, frames]) => {
            for (let k = 1; k <= frames; k++) {
                (0, eval)(move)(k);
                await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
            }
        }""",
        [move, frames],
    )
    return {name: count / frames for name, count in page.evaluate("work").items()}


@pytest.fixture
def counted(ledges: str, visit: Visit) -> dict[str, Any]:
    pages = {name: visit(ledges, f"{name}/index.html") for name in ("coarse", "fine")}
    for page in pages.values():
        page.evaluate(COUNT)
    return pages


def test_a_frame_of_the_map_costs_the_same_however_fine_the_slice_is(counted: dict[str, Any]) -> None:
    """Nothing is decoded, laid out, resized or allocated while the map moves, and its data are one picture."""
    moves = "(k) => setView(2 + (k % 3) / 8, 0.2 + k / 200, 0.1)"
    found = {name: work(page, moves) for name, page in counted.items()}
    for calls in found.values():
        assert not NEVER & calls.keys()
        assert calls["drawImage"] == 1 + 2  # the losses; the failures, cut out of their stripes
        assert "putImageData" not in calls
    steady = {
        name
        for name in found["fine"]
        if name not in ("measureText", "fillText", "moveTo", "lineTo", "beginPath", "stroke")
    }
    assert {name: found["fine"][name] for name in steady} == {name: found["coarse"][name] for name in steady}
    for name in ("fillText", "lineTo"):  # ticks, which are as many as there is room for
        assert abs(found["fine"][name] - found["coarse"][name]) <= 8


def test_a_frame_of_the_map_reads_no_node(ledges: str, visit: Visit) -> None:
    """The arrays of colours are taken away, and the map moves on as if they were there."""
    seen = []
    for taken in (False, True):
        page = visit(ledges, "fine/index.html")
        page.evaluate(DRAWN)
        if taken:
            page.evaluate("structuredClone(0, { transfer: [colours, levels, drawnLosses].map((one) => one.buffer) })")
            assert page.evaluate("colours.length + levels.length + losses.length") == 0
        page.evaluate("setView(2.5, 0.3, 0.5)")
        seen.append(pixels(page, "map"))
    assert (seen[0] == seen[1]).all()


@pytest.mark.parametrize(
    ("move", "pictures", "put", "lines"),
    [("(k) => setView(2, 0.2 + k / 200, 0.1)", 1 + 2 + 2 + 1, 0, 100),
     ("(k) => { turning = true; turn(0.05, 0.001); }", 1, 1, 40)],
)  # fmt: skip
def test_layers_over_a_moving_map_are_pictures_and_a_turning_surface_is_one(
    counted: dict[str, Any], move: str, pictures: int, put: int, lines: int
) -> None:
    for page in counted.values():
        for layer in ("isolines", "finer"):
            page.check(f"input[name={layer}]")
        calls = work(page, move)
        assert not NEVER & calls.keys()
        assert (calls["drawImage"], calls.get("putImageData", 0)) == (pictures, put)
        assert calls["lineTo"] < lines
