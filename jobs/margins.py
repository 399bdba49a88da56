"""The margins of scenes: what `landscape extremes` measured of them, kept where `landscape envs NAME` finds it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from platformdirs import user_data_path

from ..landscapes.identity import MODEL_VERSION, current_identity
from ..landscapes.plain import digest
from ..landscapes.storage.disk import moved_by
from ..landscapes.storage.records import read_json, reading, write_record

if TYPE_CHECKING:
    from ..envs.base import Environment
    from ..landscapes.measures.extremes import Extremes

FOLDER = "extremes"


def keep(found: Extremes) -> Path | None:
    """Keep extremes where `say_margins` finds them, in the user's data folder, in the place of earlier ones.

    Those that say nothing of the step are not kept: None is returned.
    """
    if not any(limit.knob == "dt" for limit in found.limits):
        return None
    known = found.identity
    decides = [known["settings"], known["options"], known["engine"]]
    path = _folder() / f"{found.env}-{known['device']}-{digest(decides)}.json"
    with moved_by("XDG_DATA_HOME", "what was measured"):
        write_record(path, found.record())
    return path


def say_margins(env: Environment) -> list[str]:
    """Return a line for each kept measurement of a scene with these options: its step against its stability limit."""
    said = list[str]()
    for path, record in _records(env.name):
        with reading(path, f"delete it, and `landscape extremes {env.name}` measures it anew"):
            if record["identity"]["options"] == asdict(env.options):
                said += _sentences(record, env)
    return list(dict.fromkeys(said)) or [f"stability: not measured; `landscape extremes {env.name}` measures it"]


def _sentences(record: dict[str, Any], env: Environment) -> Iterator[str]:
    """Yield what a record says of the step in each precision, and where and of what settings it was measured."""
    known = record["identity"]
    of = f"{known['engine']} on {known['device']}, {record['points']} points, {record['provenance']['created']}"
    if (theirs := known[MODEL_VERSION]) != (ours := env.version_on(known["engine"])):
        of += f", by {env.name} model {theirs}, this is model {ours}"
    now = env.fidelities.get(record["fidelity"])
    if now is not None and (others := now.changes_from(known["settings"])):
        of += f", when {record['fidelity']} had {', '.join(f'{name} {value}' for name, (value, _) in others.items())}"
    for limit in record["limits"]:
        if limit["knob"] == "dt":
            right = _accuracy(record, limit)
            yield f"stability: {_margin(record['fidelity'], limit)}; {right} ({limit['precision']}; {of})"


def _margin(fidelity: str, limit: dict[str, Any]) -> str:
    """Say in words how the step stands to the largest stable one."""
    if limit["stable"] is None:
        return f"no step as long as {fidelity}'s was stable, nor a shorter one that was tried"
    if limit["failed"] is None:
        return f"{fidelity}'s step is stable, and so is one {limit['stable'] / limit['base']:.3g} times as long"
    share = "" if limit["stable"] == limit["base"] else f"{limit['margin']:.2g} of "
    stable = f"{fidelity}'s step is {share}the largest stable one, {limit['stable']:.3g} s"
    return f"{stable} ({limit['beyond']} at {limit['failed']:.3g} s)"


def _accuracy(record: dict[str, Any], limit: dict[str, Any]) -> str:
    """Say in words up to which step losses are right."""
    of = f"within {record['accuracy']:.0%} of the spread of {record['reference']}'s"
    if limit["accurate"] is None:
        return f"its losses are not {of}"
    if limit["wrong"] is None:
        return f"all losses are {of}"
    return f"losses are {of} up to {limit['accurate']:.3g} s, of which it is {limit['accurate_margin']:.2g}"


def _records(name: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the records that are kept of a scene, the user's own before the gallery's; of a fidelity the first."""
    shipped = Path(str(resources.files("gradscape.gallery"))) / "data" / FOLDER
    seen = set[str]()
    for folder in (_folder(), shipped):
        for path in sorted(folder.glob("*.json")) if folder.is_dir() else []:
            if path.name.startswith((f"{name}-cpu", f"{name}-cuda")):
                with reading(path, f"delete it, and `landscape extremes {name}` measures it anew"):
                    record = read_json(path)
                    record["identity"] = known = current_identity(record["identity"])
                    key = digest([known["settings"], known["options"], known["engine"], known["device"]])
                if key not in seen:
                    seen.add(key)
                    yield path, record


def _folder() -> Path:
    return user_data_path("gradscape") / FOLDER
