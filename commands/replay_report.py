"""What `landscape replay` does and prints."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..envs.registry import make
from ..jobs.scene import point_of
from ..jobs.scene import provenance as provenance_of
from ..landscapes.storage.files import other_files, tidy, write_json
from .arguments import read_settings
from .terminal import Console

if TYPE_CHECKING:
    from torch import Tensor

    from ..envs.base import Environment
    from ..landscapes.draw.figures.contact import Caption

SHEET, FILM, LOOP, RECORD = "episode.png", "episode.mp4", "episode.gif", "episode.json"
STREAM = "episode.rrd"


def replay(
    name: str,
    *,
    params: str,
    fidelity: str | None,
    device: str,
    engine: str,
    settings: Sequence[str],
    out: str | None,
    film: bool,
    prints: Sequence[float] = (),
) -> None:
    """Simulate one episode, draw it, and say what it cost."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    env = make(name, fidelity=fidelity, device=device, engine=engine, **read_settings(settings))
    x = point_of(env, params)
    folder = _folder(out, env, x)
    with console.status(f"{env.name}: simulating (kernels are compiled once, then kept)"):
        episode = env.episode(x)
        result = env.evaluate(x[None], grad=False)
    loss, status = float(result.loss[0]), int(result.status[0])
    from ..landscapes.draw.figures.contact import episode_figure, save_sheet
    from ..landscapes.draw.figures.page import save_prints
    from ..landscapes.draw.recordings.episode import save_episode
    from ..landscapes.draw.render.replay import save_replay

    caption = _caption(env, params, x, loss, status)
    console.print(f"{caption.title}: {len(episode.time)} instants to draw{', and to film' if film else ''}")
    with console.status(f"{env.name}: drawing"):
        save_sheet(episode, folder / SHEET, caption=caption)
        said = f"{caption.title} · {caption.outcome}"
        save_episode(episode, folder / STREAM, title=said)
        files = [SHEET, STREAM]
        if film:
            save_replay(episode, folder / FILM, folder / LOOP, title=said)
            files += [FILM, LOOP]
        draw = partial(episode_figure, episode, caption=caption)
        files += save_prints(lambda width: draw(width=width), folder / SHEET, prints)
    _write_record(env, x, loss, status, folder / RECORD)
    tidy(folder)
    console.print(
        f"{caption.title} · {env.device} · {caption.outcome}\n{folder}: {', '.join([*files, RECORD])}", markup=False
    )


def _caption(env: Environment, params: str, x: Tensor, loss: float, status: int) -> Caption:
    """Say what an episode is."""
    from ..landscapes.draw.figures.contact import Caption
    from ..landscapes.draw.style import FAILURES, number
    from ..landscapes.objective import Status

    failed = Status(status) != Status.OK
    outcome = f"no loss: {FAILURES[Status(status)]}" if failed else f"loss {number(loss)} {env.loss_unit}".rstrip()
    values = {
        name: f"{number(value)} {unit}".rstrip()
        for name, value, unit in zip(env.space.names, x.tolist(), env.space.units, strict=True)
    }
    about = provenance_of(env, _command())
    said = [f"gradscape {__version__}", env.device, str(about["created"]), str(about["command"])]
    return Caption(f"{env.name} · {env.fidelity.name}", outcome, params, values, RECORD, " · ".join(said))


def _command() -> str:
    return shlex.join(["landscape", *sys.argv[1:]])


def _folder(out: str | None, env: Environment, x: Tensor) -> Path:
    if out is None:
        settings = json.dumps([env.identity(), x.tolist()], sort_keys=True)
        return Path("out") / f"replay-{env.name}-{hashlib.sha256(settings.encode()).hexdigest()[:6]}"
    folder = Path(out)
    if other_files(folder, (SHEET, STREAM, FILM, LOOP, RECORD), SHEET):
        raise ValueError(f"{folder} holds other files; give --out a new or an empty folder")
    return folder


def _write_record(env: Environment, x: Tensor, loss: float, status: int, path: Path) -> None:
    """Keep what was drawn, and how it came about."""
    from ..landscapes.objective import Status

    record: dict[str, Any] = {
        "identity": env.identity(),
        "provenance": provenance_of(env, _command()),
        "parameters": dict(zip(env.space.names, x.tolist(), strict=True)),
        "loss": loss if status == Status.OK else None,
        "status": Status(status).name,
    }
    write_json(path, record)
