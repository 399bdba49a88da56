"""Films: MP4 and GIF, by the ffmpeg in the wheel of imageio-ffmpeg."""

from __future__ import annotations

import io
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from ..storage.files import replacing

Picture = NDArray[np.uint8]

GIF_WIDTH = 800  # most pixels across
GIF_PIXELS = 16e6  # most in all frames of a GIF, which then stays near 5 MB


def picture(figure: Figure, *, dpi: int) -> Picture:
    """Return a figure as an RGB picture, shape (height, width, 3), with even sides as films need them."""
    figure.set_dpi(dpi)
    width, height = figure.canvas.get_width_height()
    raw = io.BytesIO()
    figure.savefig(raw, format="rgba", dpi=dpi)
    pixels: Picture = np.frombuffer(raw.getvalue(), np.uint8).reshape(height, width, 4)
    return np.ascontiguousarray(pixels[: height // 2 * 2, : width // 2 * 2, :3])


def save_film(
    pictures: Iterable[Picture], mp4: Path, gif: Path | None, *, count: int, rate: int, loss: int = 18
) -> None:
    """Write `count` pictures of one size as an MP4, and as a GIF with one palette, at `rate` pictures a second.

    `loss` is x264's constant rate factor: 18 looks like the pictures, 28 takes about a third of the bytes.

    Raises OSError if ffmpeg cannot write them.
    """
    pictures = iter(pictures)
    first = next(pictures)
    with ExitStack() as stack:
        paths = [stack.enter_context(replacing(path)) for path in (mp4, gif) if path]
        log = stack.enter_context(tempfile.TemporaryFile())
        command = _command(first.shape[1], first.shape[0], count, rate, paths, loss)
        encoder = stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log))
        try:
            _feed(encoder, chain([first], pictures))
        except BaseException:
            encoder.kill()
            raise
        if encoder.wait():
            log.seek(0)
            said = log.read().decode(errors="replace").strip()[-500:]
            raise OSError(f"ffmpeg could not write {mp4}{f' and {gif}' if gif else ''}: {said}")


def _feed(encoder: subprocess.Popen[bytes], pictures: Iterable[Picture]) -> None:
    assert encoder.stdin is not None
    try:
        for one in pictures:
            encoder.stdin.write(one.tobytes())
        encoder.stdin.close()
    except BrokenPipeError:  # it ended early and says why
        return


def save_still(picture: Picture, path: Path) -> None:
    """Write a picture as a small WebP."""
    with replacing(path) as partial:
        Image.fromarray(picture).save(partial, "WEBP", quality=80, method=6)


def lighten(path: Path) -> None:
    """Rewrite a PNG with 256 colours, which makes a diagram three times smaller."""
    with Image.open(path) as picture, replacing(path) as partial:
        few = picture.convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        few.save(partial, "PNG", optimize=True)


def _command(width: int, height: int, count: int, rate: int, paths: list[Path], loss: int) -> list[str]:
    from imageio_ffmpeg import get_ffmpeg_exe

    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(rate), "-i", "-"]
    film = ["-c:v", "libx264", "-preset", "slow", "-crf", str(loss), "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    call = [get_ffmpeg_exe(), "-hide_banner", "-loglevel", "error", "-y", *source]
    if len(paths) == 1:
        return [*call, *film, "-f", "mp4", str(paths[0])]
    fits = (GIF_PIXELS / count * width / height) ** 0.5
    across = int(min(GIF_WIDTH, width, fits)) // 2 * 2
    graph = (
        f"[0:v]split[film][small];[small]scale={across}:-2:flags=lanczos,split[a][b];"
        "[a]palettegen=stats_mode=full[palette];[b][palette]paletteuse=dither=none[gif]"
    )  # one palette, undithered: a colour means the same in every frame
    return [
        *(*call, "-filter_complex", graph),
        *("-map", "[film]", *film, "-f", "mp4", str(paths[0])),
        *("-map", "[gif]", "-loop", "0", "-f", "gif", str(paths[1])),
    ]
