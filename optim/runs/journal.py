"""The journal of a run, its file `state`: which rows count, their checksums, and what the optimiser goes on from.

Its first line is the SHA-256 digest of all that follows, its second a JSON object, and the rest what `state.encode`
wrote. A file that is not what was written is refused, whatever became of it.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ...landscapes.identity import ERROR, StoreError
from ...landscapes.storage.files import replacing

STATE = "state"
CHUNK = 64  # rows
CHANGING = {"budget", "gradient_cost", ERROR}  # attributes of a run that are not what they were when it was made


@dataclass(frozen=True)
class Journal:
    """What the file holds.

    `rows` are there, `told` of them the optimiser has been told; `sums` are the checksums of every 64 of them.
    `gradient_cost` is that of the run, `about` the digest of what the run says of itself; `state` is encoded.
    """

    rows: int = 0
    told: int = 0
    gradient_cost: float | None = None
    about: str = ""
    sums: list[int] = field(default_factory=list)
    state: bytes = b""

    def write(self, run: Path) -> None:
        """Write the file into a run's folder, whole or not at all."""
        head = asdict(replace(self, state=b"")) | {"state": len(self.state)}
        content = json.dumps(head).encode() + b"\n" + self.state
        with replacing(run / STATE) as partial:
            partial.write_bytes(hashlib.sha256(content).hexdigest().encode() + b"\n" + content)

    @classmethod
    def read(cls, run: Path) -> Journal:
        """Read the file of a run. Raises StoreError, which names it, where it is missing or not what was written."""
        try:
            digest, _, content = (run / STATE).read_bytes().partition(b"\n")
        except OSError as error:
            raise damage_error(run / STATE, f"it cannot be read ({error.strerror})") from None
        if digest.decode(errors="replace") != hashlib.sha256(content).hexdigest():
            raise damage_error(run / STATE, "it is not what was written")
        head, _, state = content.partition(b"\n")
        try:
            return cls(**(json.loads(head) | {"state": state}))
        except (TypeError, ValueError) as error:
            raise damage_error(run / STATE, str(error)) from None


def damage_error(path: Path, why: str) -> StoreError:
    """Return the error that says of a run, or of a file in it, that it is not what was written."""
    return StoreError(f"{path} is damaged: {why}; restore it, or begin the run anew in another folder")


def digest_of(attributes: Mapping[str, Any]) -> str:
    """Return a digest of what a run says of itself, but for what changes while it is filled."""
    lasting = {name: value for name, value in attributes.items() if name not in CHANGING}
    return hashlib.sha256(json.dumps(lasting, sort_keys=True).encode()).hexdigest()


def checksums(columns: Mapping[str, NDArray[Any]], count: int, known: list[int]) -> list[int]:
    """Return the checksum of every 64 of the first `count` rows, given those of the first ones.

    Each begins with the number of its first row, so that rows in another place have another one.
    """
    found = list(known)
    for low in range(len(known) * CHUNK, count, CHUNK):
        total = zlib.crc32(str(low).encode())
        for values in columns.values():
            total = zlib.crc32(values[low : min(low + CHUNK, count)].tobytes(), total)
        found.append(total)
    return found


def find_damage(sums: list[int], journal: Journal) -> range | None:
    """Return the first rows whose checksum is not the journal's, None where all are right."""
    for low, pair in zip(range(0, journal.rows, CHUNK), zip_longest(sums, journal.sums), strict=False):
        if len({*pair}) > 1:
            return range(low, min(low + CHUNK, journal.rows))
    return None
