"""What `landscape replay` does and prints."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from .console import provenance_of, read_settings
from .envs.registry import make
from .landscapes.files import visible, write_json
from .results import point_of

if TYPE_CHECKING:
    from torch import Tensor

    from .envs.base import Environment

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
    from .landscapes.draw.episode_stream import save_episode
    from .landscapes.draw.replay import save_replay, save_sheet

    with console.status(f"{env.name}: drawing"):
        save_sheet(episode, folder / SHEET)
        said = f"{env.name}, {env.fidelity.name}: loss {loss:.4g} {env.loss_unit}".strip()
        save_episode(episode, folder / STREAM, title=said)
        files = [SHEET, STREAM]
        if film:
            save_replay(episode, folder / FILM, folder / LOOP)
            files += [FILM, LOOP]
    _write_record(env, x, loss, status, folder / RECORD)
    console.print(
        f"{env.name} · {env.fidelity.name} · {env.device}: loss {loss:.4g} {env.loss_unit}\n"
        f"{folder}: {', '.join([*files, RECORD])}",
        markup=False,
    )


def _folder(out: str | None, env: Environment, x: Tensor) -> Path:
    if out is None:
        settings = json.dumps([env.identity(), x.tolist()], sort_keys=True)
        return Path("out") / f"replay-{env.name}-{hashlib.sha256(settings.encode()).hexdigest()[:6]}"
    folder = Path(out)
    known = {SHEET, STREAM, FILM, LOOP, RECORD}
    if any(file.name not in known for file in visible(folder)):
        raise ValueError(f"{folder} holds other files; give --out a new or an empty folder")
    return folder


def _write_record(env: Environment, x: Tensor, loss: float, status: int, path: Path) -> None:
    """Keep what was drawn, and how it came about."""
    from .landscapes.objective import Status

    command = shlex.join(["landscape", *sys.argv[1:]])
    record: dict[str, Any] = {
        "identity": env.identity(),
        "provenance": provenance_of(env, command),
        "parameters": dict(zip(env.space.names, x.tolist(), strict=True)),
        "loss": loss if status == Status.OK else None,
        "status": Status(status).name,
    }
    write_json(path, record)
