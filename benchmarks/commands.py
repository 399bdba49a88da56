"""Say generated command lines to every verb, and see how they end.

    python -m benchmarks.commands [--count 1000] [--seed 0] [--verb slice --verb race] [--json]

A command line is a valid one with one to three of its words lost, put in or replaced: options are those that the
command declares, values are hostile ones (numbers beyond every size, markup, bytes that are no text, link loops, deep
paths, damaged results). Each is run in a folder of its own that holds results of all kinds, whole and damaged, within
limits of time and memory. It has to end by itself, or by Ctrl-C once it has said how long it takes, with exit code 0,
1, 2 or 130, and where that is not 0 with a line that says why. Exit code 1 says that one did not.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shlex
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import typer
from benchmarks import damage, forked, results, seeded
from benchmarks.forked import Ended, Limits

from gradscape.cli import app

VALID = """
envs branin
info
slice branin --dims 0 1 --resolution 3 --through center --window 0.5 --out made
slice ackley --dims x0 x1 --set dim=3 --no-gradients --json --resolution 3
slice branin --dims 0 1 --resolution 17 --refine 10% --budget 100
slice bounce --dims 0 1 --resolution 3 --fidelity draft --tolerance 20%
slice own.py:Bowl --dims 0 1 --resolution 3
sweep ackley --dims 0 1 --over 2 --set dim=3 --frames 2 --resolution 3
methods cma-es
optimize branin --method cma-es --budget 5 --seed 1 --option sigma=0.2
optimize ackley --method bo-leap --budget 12 --set dim=3 --option initial=4
optimize cartpole --method descents --budget 4 --fidelity draft --option learning_rate=0.1
race branin --methods random,cma-es --budget 5 --seeds 2 --workers 2 --option cma-es.sigma=0.2
league branin ackley@exact --methods random,cma-es --budget 5 --seeds 2 --workers 2
overlay cut run --resolution 3 --plane pca
overlay cut race --through best
surface cut run
compare cut branin --device cpu
compare cut cut --force
replay bounce --params point.json --no-film
export run --to csv --out made.csv
export cut --to netcdf --out made.nc
view cut
bounce --axis y --resolution 3 --window 0:1 --fidelity draft
bench branin --batch 2 --seconds 0
check branin --points 2
tradeoff bounce --points 2 --variants precision
extremes bounce --points 4 --knobs dt --pairs none --fidelity draft
pairs ackley --samples 2 --top 3 --set dim=3
census ackley --slices 4 --resolution 6 --set dim=3 --along random
card --scene control --resolution 3
report cut --points 2
report --all --data data --points 2
plan bounce --dims 0 1 --resolution 3 --workers 2 --over horizon --frames 2
plan figures.toml --resolution 3
gallery compute --only pinball-2-0-1 --part slices --resolution 3 --data data --fidelity draft
gallery list --json --data data
gallery build --out site --data data
gallery serve --out site --port 0
""".strip().splitlines()
NUMBERS = ("0", "-1", "1", "2", "7", "1e9", "1e308", "-1e308", "1e400", "nan", "inf", "-inf", "0x10", "1_000", "\u0663")
NUMBERS += ("100000", "1000000", "2147483648", "9223372036854775808", "9" * 400, "1.5", "5e-324", "1e-300", "-0.0", "")
SIZES = ("0", "1", "2", "3", "85", "3000", "100000", "1000000", "2147483648", "100000000000", "9223372036854775808")
WORDS = ("", " ", "-", "--", "=", "=1", "a=", "a,b", ",", ":", "0:1", "1:0", "nan:1", "0:inf", "5%", "nan%", "[/b]")
WORDS += (
    "[red]x",
    "{}",
    "%s",
    "%00",
    "\0",
    "\udcff",
    "\u00e4 b",
    "x" * 5000,
    "d/" * 2000,
    "\n",
    "*",
    "..",
    "/",
    "~",
    "$HOME",
)
WORDS += (
    "center",
    "random:0",
    "random:-1",
    "random:" + "9" * 30,
    "example:aim",
    "example:[/b]",
    "best:run",
    "best:race",
)
WORDS += (
    "horizon",
    "smoothing",
    "pca",
    "x0",
    "draft",
    "reference",
    "cpu",
    "cuda",
    "taichi",
    "parquet",
    "local:0",
    "local:x",
)
WORDS += ("branin", "ackley", "bounce", "fluid", "cartpole", "sac", "ppo", "bo", "own.py:Bowl", "own.py:Torn", "own.py")
NAMES = ("device", "engine", "fidelity", "deterministic", "name", "self", "dim", "horizon", "seed", "sigma", "initial")
NAMES += (
    "learning_rate",
    "minibatches",
    "epochs",
    "warmup",
    "precision",
    "space",
    "cma-es.sigma",
    "random.x",
    "options",
)
MADE = {
    "cut": "slice branin --dims 0 1 --resolution 4 --out",
    "run": "optimize branin --method cma-es --budget 12 --seed 1 --out",
    "race": "race branin --methods random,descents --budget 6 --seeds 2 --out",
    "sweep": "sweep ackley --dims 0 1 --over 2 --set dim=3 --frames 2 --resolution 3 --out",
    "study": "pairs ackley --samples 2 --set dim=3 --out",
    "traded": "tradeoff bounce --points 2 --variants precision --device cpu --out",
    "reported": "report cut --points 2 --out",
    "data": "gallery compute --only pinball-2-0-1 --part slices --resolution 4 --fidelity draft --device cpu --data",
    "site": "gallery build --data data --out",
}
TORN = ("cut", "run", "race", "traded", "data")
OWN = seeded.OWN + "\n\nclass Torn: pass\n"
SAID_HOW_LONG = re.compile(
    r"about [\d.]|or more, without|to draw|is at http|until Ctrl-C|are there already|to compute|to measure"
)
WARNING = re.compile(r"^\S+\.py:\d+: \w*Warning: ", re.MULTILINE)  # of a library, to whom it may concern
RAW = re.compile(  # other people's errors, which say nothing of what is to be done
    r"landscape: (None$|Expecting |Extra data|invalid literal|could not convert|math domain|\[Errno|embedded null|"
    r"'utf-8'|not enough values|too many values|list index|cannot reshape|.*object has no attribute|\d+$|'\w*'$)"
)


@dataclass(frozen=True)
class Said:
    """A command line, how it ended, and what it said last."""

    verb: str
    words: tuple[str, ...]
    outcome: str
    last: str


@cache
def verbs() -> dict[str, Any]:
    """Return every verb of the command with what it declares, those of the gallery by both of their words."""

    def walk(command: Any, name: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        inner = getattr(command, "commands", None)
        if inner is None:
            yield " ".join(name), command
        for word, below in (inner or {}).items():
            yield from walk(below, (*name, word))

    found = dict(walk(typer.main.get_command(app), ()))
    if without := [verb for verb in found if not _valid(verb)]:
        raise RuntimeError(f"VALID has no command line of {', '.join(without)}; add one each")
    return found


def _valid(verb: str) -> list[list[str]]:
    lines = [line.split() for line in VALID]
    return [line for line in lines if line[: len(verb.split())] == verb.split()]


def generated(chance: random.Random, places: Sequence[str], wanted: Sequence[str] = ()) -> tuple[str, list[str]]:
    """Return a verb, one of those wanted if any, and a command line of it."""
    known = verbs()
    verb = chance.choice(list(wanted or known))
    line = list(chance.choice(_valid(verb)))
    first = len(verb.split())
    for _ in range(chance.randint(1, 3)):
        at = chance.randint(first, len(line))
        kind = chance.randrange(8)
        if kind < 4:
            line[len(line) :] = _option(chance, known[verb], places)
        elif kind < 7 and at < len(line) and not line[at].startswith("--"):
            line[at] = _value(chance, line[at - 1], places)
        elif kind == 7:
            line[at : at + chance.randrange(2)] = [_value(chance, "", places)] * chance.randrange(2)
    return verb, line


def _option(chance: random.Random, command: Any, places: Sequence[str]) -> list[str]:
    """Return an option that a verb declares, with a value where it takes one."""
    options = [param for param in command.params if param.opts[0].startswith("-")]
    if not options:
        return [chance.choice(["--help", "-h", "--none", "--version"])]
    param = chance.choice(options)
    name = chance.choice([*param.opts, *param.secondary_opts])
    return [name] if param.is_flag else [name, _value(chance, name, places)]


def _value(chance: random.Random, after: str, places: Sequence[str]) -> str:
    """Return a value, after an option mostly one that could be meant for it."""
    if after in ("--set", "--option") and chance.randrange(4):
        return f"{chance.choice(NAMES)}={chance.choice([*NUMBERS, *WORDS])}"
    numeric = ("--resolution", "--frames", "--budget", "--seed", "--seeds", "--points", "--samples", "--top", "--batch")
    numeric += ("--seconds", "--workers", "--port", "--figure-width-mm", "--window", "--tolerance")
    if after in numeric and chance.randrange(5):
        return chance.choice(SIZES if chance.randrange(3) else NUMBERS)
    return chance.choice(chance.choice([NUMBERS, WORDS, places]))


def set_desk(folder: Path, limits: Limits, made: Sequence[str] = tuple(MADE)) -> None:
    """Fill a folder with results of the kinds named, damaged ones, files of no use and names of bad kinds."""
    folder.mkdir()
    (folder / "point.json").write_text("[1.0, 2.0, 0.5]")
    (folder / "f.json").write_text('{"a": [1, "b"]}')
    (folder / "f.toml").write_text("figure = 3\n")
    (folder / "own.py").write_text(OWN)
    figure = '[[figure]]\nid = "one"\nenv = "branin"\ndims = [0, 1]\nsays = "x"\nresolution = 3\nfidelity = "exact"\n'
    (folder / "figures.toml").write_text(figure)
    (folder / "empty").write_bytes(b"")
    (folder / "bytes.json").write_bytes(bytes(range(256)))
    chance = random.Random(0)
    for name, command in ((name, MADE[name]) for name in made):
        ended = forked.landscape([*command.split(), name], folder, limits=limits, before=results.small)
        if ended.code:
            raise RuntimeError(f"{command} {name} ended with {ended.code}: {ended.err}")
    for name in (one for one in TORN if one in made):
        shutil.copytree(folder / name, folder / f"torn-{name}")
        for file in chance.sample(damage.files(folder / f"torn-{name}"), 2):
            damage.damage(chance, file)
    for odd in (b"\xff\xfe", b"[b]", "ä b".encode(), b"-x"):
        (folder / os.fsdecode(odd)).symlink_to("cut")
    (folder / "[").mkdir()  # so that [/b] is a place
    (folder / "[/b]").symlink_to("../data")
    (folder / "loop").symlink_to("loop")
    (folder / "away").symlink_to("/")
    (folder / "gone").symlink_to("nowhere")
    (folder / "thesis").mkdir()
    (folder / "thesis/manifest.json").write_text("{}")
    (folder / "thesis/chapter.tex").write_text("years of work")


def places(desk: Path) -> list[str]:
    """Return the names of what is on a desk, and of some of what is in there."""
    own = sorted(path.name for path in desk.iterdir() if path.name not in ("home", "tmp", "thesis"))
    return [*own, *(f"{name}/slice.zarr" for name in ("cut", "torn-cut")), "run/run.zarr", "race/random-0", "away/tmp"]


def say(line: Sequence[str], desk: Path, folder: Path, limits: Limits, before: Any = None) -> Ended:
    """Say a command line in a copy of a desk, after `before`."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(desk, folder, symlinks=True)
    serving = "--serve" in line or line[:2] == ["gallery", "serve"]
    patience = Limits(limits.cpu, 8.0, limits.memory) if serving else limits
    return forked.landscape(line, folder, limits=patience, before=before)


def outcome(ended: Ended, folder: Path) -> str:
    """Say in a word how a command ended: its exit code, or what is wrong with that."""
    if failed := forked.failure(ended):
        return failed
    if ended.stopped and not SAID_HOW_LONG.search(ended.err + ended.out):
        return "limit: time"
    if ended.code in (1, 2) and RAW.search(ended.err):
        return "raw error"
    if ended.code == 2 and (not ended.err.startswith("landscape: ") or len(ended.err.strip().splitlines()) > 1):
        return "not one line"
    if WARNING.search(ended.err):
        return "warning"
    if not (folder / "thesis/chapter.tex").exists():
        return "removed what is not its own"
    return str(ended.code)


def trial(
    count: int, seed: int, root: Path, wanted: Sequence[str] = (), limits: Limits | None = None
) -> Iterator[Said]:
    """Say so many command lines, and yield how each ended."""
    limits = limits or Limits(cpu=20, clock=40)
    desk, folder = root / "desk", root / "at"
    set_desk(desk, Limits(cpu=120, clock=300))
    on_desk = places(desk)
    for number in range(count):
        verb, line = generated(random.Random(f"{seed}-{number}"), on_desk, wanted)
        ended = say(line, desk, folder, limits)
        yield Said(verb, tuple(line), outcome(ended, folder), forked.last_words(ended.err))


def table(all_said: Sequence[Said]) -> str:
    """Return how many command lines of each verb ended how."""
    counts = Counter((said.verb, said.outcome) for said in all_said)
    shown = sorted({said.outcome for said in all_said}, key=lambda name: (not name.isdigit(), len(name), name))
    rows = [f"| verb | {' | '.join(shown)} |", f"|---|{'---|' * len(shown)}"]
    for verb in sorted({said.verb for said in all_said}):
        rows.append(f"| {verb} | {' | '.join(str(counts[verb, one]) for one in shown)} |")
    return "\n".join(rows)


def main() -> None:
    """Print how command lines ended, and every one that did not as it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verb", action="append", choices=list(verbs()))
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    forked.load()
    found = list[Said]()
    with tempfile.TemporaryDirectory() as root:
        for said in trial(given.count, given.seed, Path(root), given.verb or ()):
            found.append(said)
            if not said.outcome.isdigit():
                words = shlex.join(word if len(word) < 200 else f"{word[:20]}...({len(word)})" for word in said.words)
                print(f"{len(found) - 1}: {said.outcome}: landscape {ascii(words)[1:-1]}\n  {ascii(said.last)[1:-1]}",
                      file=sys.stderr, flush=True)  # fmt: skip
    if given.json:
        print(json.dumps([said.__dict__ for said in found]))
    else:
        print(f"{len(found)} command lines\n\n{table(found)}")
    sys.exit(int(any(not said.outcome.isdigit() for said in found)))


if __name__ == "__main__":
    main()
