"""What tests ask of a page in a browser."""

import base64
import io
from typing import Any

import numpy as np
from PIL import Image

DRAWN = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


def pixels(page: Any, canvas: str) -> np.ndarray[Any, Any]:
    """Return what is on a canvas once it has been drawn: what is asked for is drawn in the next frame."""
    page.evaluate(DRAWN)
    picture = page.evaluate("(id) => document.getElementById(id).toDataURL()", canvas)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(picture.partition(",")[2]))))


def told(page: Any, what: str) -> float:
    line = next(line for line in page.inner_text("#readout").splitlines() if line.startswith(what))
    return float(line.split(": ")[1].split()[0].rstrip(",").replace("\N{MINUS SIGN}", "-"))


def point_at(page: Any, row: int, column: int) -> tuple[float, float]:
    """Return where a node of the map is on the screen."""
    page.locator("#map").scroll_into_view_if_needed()
    return tuple(page.evaluate(
        """([row, column]) => {
            const frame = canvas.getBoundingClientRect(), [left, top] = spot(row * columns + column);
            return [frame.left + canvas.clientLeft + left, frame.top + canvas.clientTop + top];
        }""",
        [row, column],
    ))  # fmt: skip
