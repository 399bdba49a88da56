"""Measure simulators that others wrote, and ours in turn with each, on the same scene in the same run.

    python -m benchmarks.peers [PEER ...] --device cpu --particles 1000 --substeps 64
    python -m benchmarks.peers difftaichi --source difftaichi=/path/to/diffmpm3d.py --python difftaichi=/path/to/python

Each peer runs in an environment of its own with the versions pinned in `requirements/`, which is installed into the
user's cache at its first run, or in one that `--python` names. `--json` keeps all that was measured in a file.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path

from .protocol import add_options

ROOT = Path(__file__).parents[2]
REQUIREMENTS = Path(__file__).parent / "requirements"
PEERS = {  # by name: the peer's script, and ours for the same scene
    "genesis": ("genesis_mpm", "ours_mpm"),
    "rewarped": ("rewarped_mpm", "ours_mpm"),
    "difftaichi": ("difftaichi", "ours_mpm"),
    "newton": ("newton_mpm", "ours_mpm"),
    "mjx": ("mjx_chain", "ours_chain"),
}
HEAD = ("peer", "what it was", "million work/s", "with gradient", "ours is faster", "with gradient",
        "MB, theirs : ours", "with gradient", "gradient off by", "ours off by")  # fmt: skip
WRONG = 0.05  # relative error at every step of the differences, above which a gradient is called wrong


@dataclass(frozen=True)
class Pair:
    """What a peer and ours printed of the same scene in the same run."""

    peer: str
    theirs: Mapping[str, Any]
    ours: Mapping[str, Any]

    @property
    def failed(self) -> str:
        """What went wrong, empty where nothing did."""
        return str(self.theirs.get("failed") or (f"ours: {self.ours['failed']}" if "failed" in self.ours else ""))


def interpreter(name: str, device: str) -> Path:
    """Return the interpreter of a peer's environment, made where these versions have none yet.

    Raises RuntimeError, with what pip said last, where that fails.
    """
    kinds = [("", ()), *([(".cuda", ())] if device == "cuda" else []), (".alone", ("--no-deps",))]
    files = [(path, how) for kind, how in kinds if (path := REQUIREMENTS / f"{name}{kind}.txt").is_file()]
    content = b"".join(path.read_bytes() for path, _ in files) + sys.version.encode()
    folder = user_cache_path("gradscape") / "peers" / f"{name}-{hashlib.sha256(content).hexdigest()[:12]}"
    python, done = folder / "bin" / "python", folder / "installed"
    if not done.exists():
        print(f"{name}: installing its environment into {folder}", file=sys.stderr, flush=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        commands = [[sys.executable, "-m", "venv", "--clear", str(folder)]]
        for command in commands + [[*pip, *how, "-r", str(path)] for path, how in files]:
            ended = subprocess.run(command, capture_output=True, text=True, check=False)
            if ended.returncode:
                said = [line for line in ended.stderr.splitlines() if line.strip() and "WARNING" not in line]
                raise RuntimeError(f"could not be installed: {(said or ['pip said nothing'])[-1]}")
        done.touch()
    return python


def measure(python: Path, script: str, options: Sequence[str], limit: float) -> dict[str, Any]:
    """Run a script by an interpreter, and return the JSON object on its last line; or how it failed."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")  # a peer finds nothing of ours but this folder
    env = {key: value for key, value in os.environ.items() if key not in hidden}
    if script.startswith("ours"):
        paths = filter(None, [str(ROOT / "src"), os.environ.get("PYTHONPATH")])
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [str(python), "-m", f"benchmarks.peers.{script}", *options]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=env, timeout=limit, check=False)
        found = json.loads(ended.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired:
        return {"failed": f"it ran longer than {limit:g} s"}
    except (IndexError, json.JSONDecodeError):
        said = [line for line in ended.stderr.splitlines() if line.strip()]
        return {"failed": f"it ended with {ended.returncode}: {said[-1][:200] if said else 'it said nothing'}"}
    return found if isinstance(found, dict) else {"failed": "its last line is no JSON object"}


def compare(name: str, python: Path, asked: argparse.Namespace, source: str | None) -> Pair:
    """Measure a peer and ours in turn, round by round."""
    print(f"{name}: measuring it and ours in turn, {asked.rounds} times", file=sys.stderr, flush=True)
    options = [f"--{key}={getattr(asked, key)}" for key in ("device", "repeat", "particles", "substeps")]
    theirs, ours = [], []
    for _ in range(asked.rounds):
        own = [*options, *([f"--source={source}"] if source else [])]
        theirs.append(measure(python, PEERS[name][0], own, asked.limit))
        ours.append(measure(Path(sys.executable), PEERS[name][1], options, asked.limit))
        if "failed" in theirs[-1]:
            break
    return Pair(name, best(theirs), best(ours))


def best(records: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return one record of several rounds: the first that failed, or the last with the least seconds of all."""
    if failed := [record for record in records if "failed" in record]:
        return failed[0]
    least = {key: min(record[key] for record in records) for key in ("forward", "gradient") if records[-1][key]}
    return {**records[-1], **least}


def row(pair: Pair) -> list[str]:
    """Return the cells of a peer; of one that failed, what went wrong."""
    if pair.failed:
        return [f"`{pair.peer}`", pair.failed.replace("|", "/"), *[""] * 8]
    theirs, ours = pair.theirs, pair.ours
    size = f"{theirs['particles']} x {theirs['substeps']}"
    cells = [f"{theirs['version']}; {theirs['precision']}, {theirs['material']}, grid {theirs['grid']}, {size}"]
    kinds = ("forward", "gradient")
    cells += [f"{theirs['work'] / theirs[key] / 1e6:.3g}" if theirs[key] else "none" for key in kinds]
    cells += [f"{theirs[key] / ours[key]:.3g} x" if theirs[key] else "" for key in kinds]
    memory = [(theirs[f"memory_{key}"], ours[f"memory_{key}"]) for key in kinds]
    cells += [f"{one / 1e6:.0f} : {other / 1e6:.0f}" if one else "" for one, other in memory]
    checks = (theirs["check"], ours["check"])
    return [f"`{pair.peer}`", *cells, *(f"{one['error']:.1e} (step {one['step']:g})" if one else "" for one in checks)]


def notes(pair: Pair) -> list[str]:
    """Return what has to be said of a peer next to its numbers, a line each."""
    if pair.failed:
        return [f"- `{pair.peer}` did not run."]
    theirs, ours = pair.theirs, pair.ours
    apart = abs(theirs["loss"] - ours["loss"]) / max(abs(ours["loss"]), 1e-300)
    found = [f"- `{pair.peer}`: its loss is {theirs['loss']:.7g}, ours {ours['loss']:.7g} ({apart:.1g} apart)."]
    found += [f"  - No gradient: {theirs['why']}"] if theirs["why"] else []
    if theirs["check"] and not theirs["check"]["error"] <= WRONG:
        found.append(f"  - Its gradient is wrong: {theirs['check']['error']:.2g} off at the best step of differences.")
    return found + [f"  - {sentence}" for sentence in theirs["differs"]]


def markdown(pairs: Sequence[Pair]) -> str:
    """Return the table, and below it where losses disagree, what differs, and why a gradient is missing."""
    lines = [HEAD, ("---",) * len(HEAD), *(row(pair) for pair in pairs)]
    text = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return "\n\n".join([text, *("\n".join(notes(pair)) for pair in pairs)]) + "\n"


def named(pairs: Sequence[str], option: str) -> dict[str, str]:
    """Return what was given as PEER=PATH by name. Raises ValueError for another form, or a peer that is not there."""
    found = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        if not value or name not in PEERS:
            raise ValueError(f"{option} takes PEER=PATH of {', '.join(PEERS)}; got {pair!r}")
        found[name] = value
    return found


def run(asked: argparse.Namespace) -> list[Pair]:
    """Compare all peers that were asked for; one that cannot be installed is among them, with what pip said."""
    if unknown := [name for name in asked.peers if name not in PEERS]:
        raise ValueError(f"there is no peer {unknown[0]!r}; there are {', '.join(PEERS)}")
    pythons, sources = named(asked.python, "--python"), named(asked.source, "--source")
    pairs = []
    for name in asked.peers or PEERS:
        try:
            python = Path(pythons[name]) if name in pythons else interpreter(name, asked.device)
        except RuntimeError as error:
            pairs.append(Pair(name, {"failed": str(error)}, {}))
            continue
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
