"""`landscape replay`: simulate an episode, and draw it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..jobs.scene import SceneSpec
from .arguments import Print, takes_scene


@takes_scene("tolerance", "deterministic")
def replay(
    scene: SceneSpec,
    params: Annotated[
        str,
        typer.Option(
            help="Parameters of the episode: center, random:SEED, example:NAME, best:RUN or a file of numbers."
        ),
    ] = "center",
    out: Annotated[
        str | None, typer.Option(help="Folder for the results. The default is named after the episode, under out/.")
    ] = None,
    print_: Print = None,
    film: Annotated[bool, typer.Option(help="Also film the episode, which takes about a minute.")] = True,
) -> None:
    """Simulate one episode, draw it and film it.

    The folder then holds episode.png (key frames side by side), episode.mp4 and episode.gif (films), episode.rrd (a
    3-D scene, which `landscape view` opens) and episode.json (parameters, loss and settings).

    Example: landscape replay fluid --params example:scoop
    """
    from ..jobs.episode import EpisodeJob
    from .terminal import Bars, command_line

    bars = Bars()
    env, folder = scene.make(bars), Path(out) if out else None
    job = EpisodeJob.of(env, params, command=command_line(), out=folder, film=film, prints=print_ or [])
    summary = job.run(bars)
    bars.note(f"{summary.title} · {env.device} · {summary.outcome}\n{job.folder}: {', '.join(summary.files)}")
