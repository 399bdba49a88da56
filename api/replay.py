"""`gs.replay`: simulate an episode, and draw it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Unpack

from cyclopts import Parameter

from .call import current, verb
from .options import FigureWidth, Out, Point, Scene, SceneKeywords
from .scene import environment
from .values import as_path, as_widths

if TYPE_CHECKING:
    from ..jobs.episode import EpisodeSummary


@verb
def replay(
    scene: Scene,
    *,
    params: Point = "center",
    film: Annotated[bool, Parameter(negative="--no-film")] = True,
    figure_width_mm: FigureWidth = (),
    out: Out = None,
    **keywords: Unpack[SceneKeywords],
) -> EpisodeSummary:
    """Simulate one episode, draw it and film it.

    The folder then contains episode.png (key frames side by side), episode.mp4 and episode.gif (films), episode.rrd (a
    3-D scene, which `landscape view` opens) and episode.json (parameters, loss and settings).

    Raises ValueError if the environment does not support a keyword, or if it has no episodes to draw.

    Example: landscape replay fluid --params example:scoop

    Parameters
    ----------
    params
        Parameters of the episode: center, random:SEED, example:NAME, best:RUN or a file of numbers.
    film
        Also film the episode, which takes about a minute.
    """
    call = current()
    env = environment(scene, keywords)
    from ..jobs.episode import EpisodeJob

    job = EpisodeJob.of(
        env, params, command=call.command, out=as_path(out), film=film, prints=as_widths(figure_width_mm)
    )
    return job.run(call.watch)
