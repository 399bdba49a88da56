"""Stored studies for other commands: the user's own, and those shipped with the gallery."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, cast

from ..landscapes.convert import from_json, to_json
from ..landscapes.identity import MODEL_VERSION, current_identity
from ..landscapes.options import record_options
from ..landscapes.plain import digest, number, text
from ..landscapes.storage.files import moved_by
from ..landscapes.storage.records import read_json, reading, write_record
from . import record_class
from .own_folder import STUDIES, own_folder

if TYPE_CHECKING:
    from ..envs.base import Environment
    from .convergence import ConvergenceRecord
    from .fidelity import FidelityRecord
    from .variants import StudyRecord

Record = TypeVar("Record", bound="StudyRecord")
DEVICES = ("cpu", "cuda")


def keep(found: StudyRecord) -> Path | None:
    """Store a study in the user's data folder; it replaces an earlier one with the same settings.

    None where no other command uses it, or changes of its scene cannot be detected.
    """
    kept = found.to_keep()
    if kept is None:
        return None
    settings = digest([kept.identity[name] for name in kept.kept_by])
    path = own_folder() / file_name(kept.env, kept.device, kept.kind, settings)
    with moved_by("XDG_DATA_HOME", "the measurements"):
        write_record(path, to_json(kept))
    return path


def file_name(env: str, device: str, kind: str, of: str = "") -> str:
    """Return the file name of a study, with a digest of its settings unless it is the only one."""
    return f"{env}-{device}{f'-{of}' if of else ''}.{kind}.json"


def read_study(path: Path, kind: str) -> StudyRecord:
    """Return the study of a kind in a file. Raises DamagedError for an invalid file."""
    env = re.split(r"-(?:cpu|cuda)\b", path.name)[0]
    with reading(path, f"delete it, and `landscape study {kind} {env}` measures it again"):
        found = read_json(path)
        identity = current_identity(found["identity"])
        number(identity[MODEL_VERSION])
        for name in ("engine", "device"):
            text(identity[name])
        dict(identity["options"])
        return from_json(record_class(kind), {**found, "identity": identity})


def kept_studies(kind: type[Record], env: str) -> Iterator[tuple[Path, Record]]:
    """Yield the stored studies of a kind for a scene, the user's own before the gallery's."""
    for folder in (own_folder(), Path(str(resources.files("gradscape.gallery"))) / "data" / STUDIES):
        for device in DEVICES:
            for path in sorted(folder.glob(f"{env}-{device}*.{kind.kind}.json")):
                yield path, cast("Record", read_study(path, kind.kind))


def find_fidelity(env: Environment, device: str) -> tuple[FidelityRecord, Path] | None:
    """Return the stored study of fidelities of a scene with the same options, and its file.

    One of the same device is preferred among the user's own, and then among the gallery's.
    """
    from .fidelity import FidelityRecord

    options, own = record_options(env.options), own_folder()
    found = [
        (path, record)
        for path, record in kept_studies(FidelityRecord, env.name)
        if record.identity["options"] == options
    ]
    found.sort(key=lambda one: (own not in one[0].parents, one[1].device != device))
    return (found[0][1], found[0][0]) if found else None


def find_convergence(of: FidelityRecord) -> ConvergenceRecord | None:
    """Return the stored study of convergence with the same scene and model as a study of fidelities."""
    from .convergence import ConvergenceRecord

    same = ("engine", "options", MODEL_VERSION)
    found = [
        record
        for _, record in kept_studies(ConvergenceRecord, of.env)
        if all(record.identity[key] == of.identity[key] for key in same)
    ]
    return min(found, key=lambda record: record.device != of.device, default=None)


def describe_margins(env: Environment) -> list[str]:
    """Return a line for each stored study of a scene's extremes with these options: its step and the limit."""
    from .extremes import ExtremesRecord

    said, seen = list[str](), set[str]()
    for _, record in kept_studies(ExtremesRecord, env.name):
        known = record.identity
        key = digest([known["settings"], known["options"], known["engine"], known["device"]])
        if key not in seen and known["options"] == record_options(env.options):
            said += record.margin_sentences(env)
        seen.add(key)
    return list(dict.fromkeys(said)) or [f"stability: not measured; `landscape study extremes {env.name}` measures it"]
