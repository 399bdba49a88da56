"""Where a landscape is cut: along parameters, or along directions that are named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..landscapes.identity import FILTERS, TRAINED
from ..landscapes.plain import plain_name
from .scene import named_point, plane_through, runs_in

if TYPE_CHECKING:
    from torch import Tensor

    from ..landscapes.objective import Objective
    from ..landscapes.plane import Plane
    from ..landscapes.space import ParameterSpace
    from ..landscapes.training import Training

ONE_OF = "a slice takes either --dims (one or two parameters) or --along (directions); give one of them"
PCA = "pca"
WORDS = ("center", "example", "random", "best")  # that names of points begin with
REACH, MIN_WIDTH = 0.5, 1e-3  # of a width of the box: how far a slice reaches, and what is no width for one
REACH_PER_ROOT = 1 / 8  # the same by the root of how many parameters there are: each moves by that share of its width


@dataclass(frozen=True)
class PlaneSpec:
    """Record where a landscape is cut: along one or two parameters, `dims`, or `along` named directions.

    Directions are random:SEED, gradient, hessian, pca:RUN, A:B or A:B:C, in widths of the box; filters:SEED, in norms
    of the point's filters; or training:FOLDER. The points A, B and C are named like the point it goes `through`. By
    default a cut along parameters covers the box. A cut along directions reaches half a width to each side of the
    point, and farther with more than sixteen parameters. A cut along filters reaches one norm. With at most two
    parameters and neither option, it varies all.

    Raises ValueError for parameters together with directions, and for a word that does not name directions.
    """

    dims: Sequence[int | str] | None
    along: str | None
    through: str | Tensor
    window: float | tuple[float, float] | None
    resolution: int | Sequence[int]

    def __post_init__(self) -> None:
        if self.dims and self.along is not None:
            raise ValueError(ONE_OF)
        if self.along is not None and not joined_points(self.along):
            _check_directions(self.along)

    @property
    def cut(self) -> dict[str, Any] | None:
        """What a slice along directions is known by; None for one along parameters."""
        if self.along is None:
            return None
        from .slice import JOINED

        names = joined_points(self.along)
        point = self.through if isinstance(self.through, str) else self.through.tolist()
        found = {"along": self.along, "through": point, "extent": self.window, **({JOINED: names} if names else {})}
        if self.folder is None:
            return found
        from ..landscapes.training import digest_training

        return found | {TRAINED: digest_training(self.folder)}

    @property
    def folder(self) -> Path | None:
        """The folder of the training that is cut along, None where there is none."""
        kind, _, folder = (self.along or "").partition(":")
        return Path(folder) if kind == TRAINED else None

    def training(self, objective: Objective) -> Training | None:
        """Return the training that is cut along, None where there is none; raises ValueError where it is another's."""
        from ..landscapes.training import Training

        return Training.read(self.folder, objective) if self.folder else None

    def make(self, objective: Objective, kept: Mapping[str, Any] | None = None) -> Plane:
        """Return the line or plane in an objective's space.

        `kept` says where a slice may have been begun, as for `kept_plane`: it continues along its own directions.
        Raises ValueError for parameters, points and windows that the space does not have.
        """
        through, window = self.through, self.window
        if not isinstance(through, str) and any(isinstance(one, str) for one in through):
            raise ValueError(f"a slice goes through one point here; got {len(through)} names, so make a slice for each")
        chosen = list(self.dims) if self.dims is not None else []
        if not chosen and self.along is None and objective.space.dim <= 2:
            chosen = list(range(objective.space.dim))
        if bool(chosen) == (self.along is not None):
            raise ValueError(ONE_OF)
        if self.along is None:
            return plane_through(objective, chosen, through=through, window=window, resolution=self.resolution)
        if not isinstance(self.resolution, int):
            raise ValueError(
                f"a slice along {self.along} takes one resolution for all axes; got {list(self.resolution)}"
            )
        if kept is not None and self.cut is not None:
            from .slice import kept_plane

            rank = len(joined_points(self.along)) - 1 if joined_points(self.along) else 2
            if (found := kept_plane(objective, self.cut, (self.resolution,) * rank, **kept)) is not None:
                return found
        return _plane_along(objective, self.along, through, window, self.resolution)


def _plane_along(
    objective: Objective,
    along: str,
    through: str | Tensor,
    window: float | tuple[float, float] | None,
    resolution: int,
) -> Plane:
    import torch

    from ..landscapes import directions as find
    from ..landscapes.plane import Plane

    names, space = joined_points(along), objective.space
    kind, value = ("", "") if names else _check_directions(along)
    elsewhere = window is not None or not isinstance(through, str) or through != "center"
    if (names or kind in (PCA, TRAINED)) and elsewhere:
        raise ValueError(f"--along {along} fixes the plane; leave out --through and --window")
    if names:
        return find.joining(space, [named_point(objective, name) for name in names], names, resolution)
    if kind == PCA:
        from ..landscapes.overlay import principal_plane

        return principal_plane(runs_in(objective, value), resolution=(resolution, resolution))
    if kind == TRAINED:
        from ..landscapes.training import Training

        return Training.read(Path(value), objective).plane(space, resolution)
    point = named_point(objective, through) if isinstance(through, str) else through
    if kind == FILTERS:
        spans, labels = find.filter_directions(space, point, int(value), objective.name)
        ends = (-1.0, 1.0) if window is None else _ends(window)
        return Plane.span(point, torch.from_numpy(spans), resolution=resolution, window=ends, labels=labels)
    if kind == "random":
        directions, labels = find.random_directions(space, int(value))
    elif along == "gradient":
        directions, labels = find.gradient_directions(objective, point)
    else:
        directions, labels = find.hessian_directions(objective, point)
    wide = torch.from_numpy(directions) * (space.upper - space.lower)
    lower, upper = _reach(space, point, wide) if window is None else _ends(window)
    return Plane.span(point, wide, resolution=resolution, window=(lower, upper), labels=labels)


def _check_directions(along: str) -> tuple[str, str]:
    """Return the kind of directions that a word names, and what follows it. Raises ValueError where it names none."""
    kind, _, value = along.partition(":")
    if kind == PCA and not value:
        raise ValueError("--along pca:RUN takes the folder of a run or of a race; got no folder")
    if kind == TRAINED and not Path(value or "none").is_dir():
        raise ValueError(f"--along training:FOLDER takes a folder with checkpoints of a training; got {value!r}")
    seeded = kind in ("random", FILTERS) and value.isdecimal()
    if not (along in ("gradient", "hessian") or kind in (PCA, TRAINED) or seeded):
        raise ValueError(
            "--along takes random:SEED, filters:SEED, gradient, hessian, pca:RUN, training:FOLDER, A:B or A:B:C; got "
            f"{along!r}"
        )
    return kind, value


def _reach(space: ParameterSpace, point: Tensor, spans: Tensor) -> tuple[list[float], list[float]]:
    """Return how far the box reaches along each direction from a point, and no farther than half a width of it.

    A direction of many parameters has a little of each: there it is an eighth of the root of their number, if more.
    """
    import torch

    most = max(REACH, REACH_PER_ROOT * space.dim**0.5)
    ends = [[(bound - point) / span for bound in (space.lower, space.upper)] for span in spans]
    lower = [max(-most, float(torch.minimum(*pair).nan_to_num(-most).max())) for pair in ends]
    upper = [min(most, float(torch.maximum(*pair).nan_to_num(most).min())) for pair in ends]
    # in a corner that a direction points out of there is no width
    pairs = [(-REACH, REACH) if high - low < MIN_WIDTH else (low, high) for low, high in zip(lower, upper, strict=True)]
    return [low for low, _ in pairs], [high for _, high in pairs]


def _ends(window: float | tuple[float, float]) -> tuple[float, float]:
    return window if isinstance(window, tuple) else (-window / 2, window / 2)


def split_points(through: str) -> list[str]:
    """Return the points in A,B,..., each once; a file is one, whatever its name."""
    return [through] if Path(through).is_file() else list(dict.fromkeys(filter(None, through.split(",")))) or [through]


def folder_for(out: Path, point: str, points: Sequence[str]) -> Path:
    """Return where the slice through a point belongs: `out` itself where there is one, else a folder there."""
    return out if len(points) == 1 else out / plain_name(point)


def joined_points(along: str) -> list[str]:
    """Return the names of the two or three points that a line or a plane joins, none where `along` is another word."""
    if along in ("gradient", "hessian") or along.partition(":")[0] in (PCA, FILTERS, TRAINED):
        return []
    names = points_in(along)
    return names if len(names) in (2, 3) else []


def points_in(text: str) -> list[str]:
    """Return the names of points in A:B or A:B:C; example:, random:, best: and TABLE.csv:ROW take what follows them.

    After `best` that is the folder of a run, unless it is the word that another point begins with.
    """
    parts, names = text.split(":"), list[str]()
    while parts:
        name = parts.pop(0)
        after = parts[0] if parts else ""
        row = after.isdecimal() and _is_table(name)
        takes = name in ("example", "random") or row or (name == "best" and after not in WORDS)
        names.append(f"{name}:{parts.pop(0)}" if takes and parts else name)
    return names


def _is_table(name: str) -> bool:
    from ..landscapes.foreign import SUFFIXES

    return name.lower().endswith(SUFFIXES)
