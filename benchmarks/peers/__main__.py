"""Measure simulators that others wrote, and ours in turn with each, on the same scene in the same run.

    python -m benchmarks.peers [PEER ...] --device cpu --particles 1000 --substeps 64
    python -m benchmarks.peers difftaichi --source difftaichi=/path/to/diffmpm3d.py --python difftaichi=/path/to/python

Each peer runs in an environment of its own with pinned versions, which is installed at its first run, or in one that
`--python` names. `--json` keeps all that was measured in a file.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from .environments import InstallError, interpreter
from .protocol import add_options
from .table import Pair, best, markdown

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Peer:
    """Name a peer's script and ours for the same scene."""

    script: str
    ours: str


PEERS = {
    "genesis": Peer("genesis_mpm", "ours_mpm"),
    "rewarped": Peer("rewarped_mpm", "ours_mpm"),
    "difftaichi": Peer("difftaichi", "ours_mpm"),
    "newton": Peer("newton_mpm", "ours_mpm"),
    "mjx": Peer("mjx_chain", "ours_chain"),
}


def measure(python: Path, script: str, how: Sequence[str], limit: float) -> dict[str, Any]:
    """Run a script by an interpreter, and return the JSON object on its last line; or how it failed."""
    command = [str(python), "-m", f"benchmarks.peers.{script}", *how]
    paths = os.pathsep.join(filter(None, [str(ROOT / "src"), os.environ.get("PYTHONPATH")]))
    env = {**os.environ, "PYTHONPATH": paths} if script.startswith("ours") else _without_paths()
    try:
        ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=env, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        return {"failed": f"it ran longer than {limit:g} s"}
    try:
        found = json.loads(ended.stdout.splitlines()[-1])
    except (IndexError, json.JSONDecodeError):
        said = [line for line in ended.stderr.splitlines() if line.strip()]
        return {"failed": f"it ended with {ended.returncode}: {said[-1][:200] if said else 'it said nothing'}"}
    if not isinstance(found, dict):
        return {"failed": "its last line is no JSON object"}
    return found


def _without_paths() -> dict[str, str]:
    """Return the surroundings of a process that shall find nothing of ours but this folder."""
    return {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}


def compare(name: str, python: Path, asked: argparse.Namespace, source: str | None) -> Pair:
    """Measure a peer and ours in turn, round by round."""
    how = ["--device", asked.device, "--repeat", str(asked.repeat)]
    how += ["--particles", str(asked.particles), "--substeps", str(asked.substeps)]
    own = [*how, *(["--source", source] if source else [])]
    theirs, ours = [], []
    for _ in range(asked.rounds):
        theirs.append(measure(python, PEERS[name].script, own, asked.limit))
        ours.append(measure(Path(sys.executable), PEERS[name].ours, how, asked.limit))
        if "failed" in theirs[-1]:
            break
    return Pair(name, best(theirs), best(ours))


def named(pairs: Sequence[str], option: str) -> dict[str, str]:
    """Return what was given as NAME=VALUE by name. Raises ValueError for another form, or a peer that is not there."""
    found = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not value:
            raise ValueError(f"{option} takes PEER=PATH; got {pair!r}")
        found[name] = value
    check(found, option)
    return found


def check(names: Sequence[str] | Mapping[str, str], what: str) -> None:
    """Raise ValueError for a peer that is not there."""
    for name in names:
        if name not in PEERS:
            raise ValueError(f"{what}: there is no peer {name!r}; there are {', '.join(PEERS)}")


def tell(line: str) -> None:
    """Say on standard error what is being done."""
    print(line, file=sys.stderr, flush=True)


def run(asked: argparse.Namespace) -> list[Pair]:
    """Compare all peers that were asked for; one that cannot be installed is among them, with what pip said."""
    check(asked.peers, "PEER")
    pythons, sources = named(asked.python, "--python"), named(asked.source, "--source")
    pairs = []
    for name in asked.peers or PEERS:
        try:
            python = Path(pythons[name]) if name in pythons else interpreter(name, asked.device, tell)
        except InstallError as error:
            pairs.append(Pair(name, {"failed": str(error)}, {}))
            continue
        tell(f"{name}: measuring it and ours in turn, {asked.rounds} times")
        pairs.append(compare(name, python, asked, sources.get(name)))
    return pairs


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("peers", nargs="*", metavar="PEER", help=f"of {', '.join(PEERS)}; all by default")
    add_options(parser)
    parser.add_argument("--rounds", type=int, default=2, help="how often peer and ours take turns")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds that one process may take")
    parser.add_argument("--python", action="append", default=[], metavar="PEER=PATH", help="its interpreter")
    parser.add_argument("--source", action="append", default=[], metavar="PEER=PATH", help="its file")
    parser.add_argument("--json", type=Path, help="a file for all that was measured")
    asked = parser.parse_args(arguments)
    try:
        pairs = run(asked)
    except ValueError as error:
        parser.error(str(error))
    if asked.json:
        asked.json.write_text(json.dumps([asdict(pair) for pair in pairs], indent=1) + "\n")
    print(markdown(pairs))


if __name__ == "__main__":
    main()
