"""Make random results with one checkout and with another, and say whether they have the same bits.

    python -m benchmarks.same_bits make --out OLD [--count 100] [--seed 0]    # in the old checkout, then in the new
    python -m benchmarks.same_bits compare OLD NEW                            # in any
    python -m benchmarks.same_bits reuse OLD WORKED                           # in the new

`make` runs random command lines (`benchmarks.seeded`), each in a process of its own, and lists how they ended; besides
it interrupts some, so that unfinished results are there. `compare` holds every stored array, record and table of two
such folders against each other, bit for bit, and pictures by their pixels, where they were drawn; pictures do not
decide the exit code. `reuse` copies a folder and works with the results in it: opens and exports slices and runs, lays
runs over slices, reports, gives every command again. Each of it works, or is refused in one line with exit code 2, and
nothing finished may change. Exit code 1 says that anything differed, is missing or ended otherwise.

Left out is what is measured in seconds and what follows from it (`seconds`, `gradient_cost`, `forwards` of runs that
take gradients), and what names the code, the day and the command line.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import forked, results, seeded, stored
from benchmarks.forked import Limits
from benchmarks.seeded import Command

LIST, SAID, WORKED = "list.json", "said.json", "worked"
SUMMARY = "summary.json"  # says what the last command line did, not only what is there
LIMITS = Limits(cpu=200, clock=600, memory=8e9)
ALL_THERE = re.compile(r"\ball \d+ .*there already|is there already|\b0 rungs to measure")
READS = ("open", "export", "overlay", "report")  # what always has to work
FINE = ("works", "goes on", "all there", "refused in one line")


@dataclass(frozen=True)
class Done:
    """A command line and how it ended: its exit code, its last words, and the seconds it took."""

    command: Command
    code: int
    said: str
    seconds: float

    @property
    def outcome(self) -> str:
        """Say in a few words how it ended."""
        if self.code == 2:
            one = self.said.startswith("landscape: ") and len(self.said.strip().splitlines()) == 1
            return "refused in one line" if one else "refused in other words"
        if self.code:
            return f"exit code {self.code}"
        if ALL_THERE.search(self.said):
            return "all there"
        return "goes on" if "there already" in self.said else "works"


def run(command: Command, folder: Path, before: Callable[[], object] | None = None) -> Done:
    """Run a command line in a folder and print how it ended."""
    began = time.monotonic()
    quick = before or (None if command.drawn else results.small)
    ended = forked.landscape(command.words, folder, limits=LIMITS, before=quick)
    if command.verb == "check" and ended.code in (0, 1):  # which leaves nothing else
        (folder / command.name).mkdir()
        (folder / command.name / SAID).write_text(ended.out)
    said = ended.err if ended.code in (0, 2) else forked.last_words(ended.err)
    done = Done(command, ended.code, said.replace(str(folder), ""), time.monotonic() - began)
    print(f"{done.seconds:5.1f} s  {done.outcome}: {shlex.join(command.words)}", file=sys.stderr, flush=True)
    return done


def make(folder: Path, count: int, seed: int) -> int:
    """Make so many results in a new folder, and a few unfinished ones; return how many failed."""
    folder.mkdir(parents=True)
    (folder / "own.py").write_text(seeded.OWN)
    done = [run(command, folder) for command in seeded.commands(count, seed)]
    failed = [one for one in done if one.code not in ((0, 1) if one.command.verb == "check" else (0,))]
    for command in seeded.unfinished():
        done.append(run(command, folder, partial(_interrupt, f"{command.name}/{command.stop}")))
        if done[-1].code != 130:
            failed.append(done[-1])
    _write_list(folder, done, count=count, seed=seed)
    _name_bad(failed)
    print(f"{len(done)} command lines, {len(failed)} failed; {sum(one.seconds for one in done):.0f} s")
    return len(failed)


def _interrupt(pattern: str) -> None:
    """Let Ctrl-C come with the first evaluation after something is on disk."""
    from gradscape import Environment

    results.small()
    evaluate = Environment.evaluate

    def evaluate_or_stop(self: Environment, *given: object, **options: object) -> object:
        if next(Path().glob(pattern), None):
            raise KeyboardInterrupt
        return evaluate(self, *given, **options)

    Environment.evaluate = evaluate_or_stop  # in this process alone, which the command ends


def _write_list(folder: Path, done: Iterable[Done], **about: object) -> None:
    import gradscape

    whole = {"gradscape": gradscape.__file__, **about, "commands": [asdict(one) for one in done]}
    (folder / LIST).write_text(json.dumps(whole, indent=1))


def read_list(folder: Path) -> list[Done]:
    """Return the command lines that made a folder's results."""
    whole = json.loads((folder / LIST).read_text())["commands"]
    return [Done(_command(one["command"]), one["code"], one["said"], one["seconds"]) for one in whole]


def _command(found: dict[str, Any]) -> Command:
    made: dict[str, Any] = {name: tuple(one) if isinstance(one, list) else one for name, one in found.items()}
    return Command(**made)


def compare(old: Path, new: Path, *, again: bool = False) -> int:
    """Print how many results of two folders are equal, different and missing; return how many are not equal.

    Where commands were given `again`, pictures may be drawn anew and summaries say what was done then.
    """
    counts, pictures, values = Counter[str](), Counter[str](), 0
    theirs = {one.command.name: one for one in read_list(new)} if (new / LIST).exists() else {}
    for one in read_list(old):
        if one.command.stop:
            continue
        name, other = one.command.name, theirs.get(one.command.name)
        without = (SUMMARY,) if again else ()
        wanted, found = (stored.contents(root / name, without=without) for root in (old, new))
        differ = _differences(one, other, wanted, found)
        drawn = stored.pixels(old / name) if one.command.drawn and not again else {}
        other_pixels = stored.pixels(new / name) if drawn else {}
        unlike = [file for file in drawn if drawn[file] != other_pixels.get(file)]
        pictures.update(equal=len(drawn) - len(unlike), different=len(unlike))
        outcome = "missing" if other is None or not (new / name).exists() else "different" if differ else "equal"
        counts[outcome] += 1
        values += len(wanted)
        if outcome != "equal":
            print(f"{outcome}: {name}: {'; '.join(differ[:5])}{f'; {len(differ) - 5} more' if differ[5:] else ''}")
        if unlike:
            print(f"pictures that differ: {name}: {', '.join(unlike)}")
    print(f"{counts['equal']} equal, {counts['different']} different, {counts['missing']} missing; {values} values and "
          f"arrays compared; pictures: {pictures['equal']} equal, {pictures['different']} different")  # fmt: skip
    return counts["different"] + counts["missing"]


def _differences(
    one: Done, other: Done | None, wanted: dict[str, stored.Value], found: dict[str, stored.Value]
) -> list[str]:
    if other is None:
        return ["its command line was not run"]
    differ = [] if one.command == other.command else [f"another command line: {shlex.join(other.command.words)}"]
    differ += [] if one.code == other.code else [f"exit code {one.code} / {other.code}: {other.said.strip()[-200:]}"]
    return differ + stored.differences(wanted, found)


def reuse(old: Path, folder: Path) -> int:
    """Work with results of another checkout in a copy of their folder; return how often it did not go as it must."""
    shutil.copytree(old, folder, symlinks=True, ignore=shutil.ignore_patterns("home", "tmp"))
    (folder / WORKED).mkdir()
    made = [one for one in read_list(old) if one.code == 0]
    found = list(_work(made, folder))
    _write_list(folder / WORKED, _beneath(done for _, done in found))
    counts = Counter((what, done.outcome) for what, done in found)
    again = list(_gone_on(read_list(old), folder))
    counts.update((what, done.outcome) for what, done in again)
    bad = [done for what, done in (*found, *again) if done.outcome not in (FINE[:1] if what in READS else FINE)]
    _name_bad(bad)
    for what in dict.fromkeys(what for what, _ in counts):
        said = ", ".join(f"{count} {outcome}" for (kind, outcome), count in counts.items() if kind == what)
        print(f"{what}: {said}")
    reported = list(_other_numbers(found, old, folder))
    print(*(f"other numbers: {line}" for line in reported), sep="\n", end="\n" if reported else "")
    print("finished results of before, once all was done:")
    return len(bad) + len(reported) + compare(old, folder, again=True)


def _beneath(found: Iterable[Done]) -> list[Done]:
    """Return what was made beside the results of before, by its place there, so that it can be compared, too."""
    begin = f"{WORKED}/"
    ours = [one for one in found if one.command.name.startswith(begin)]
    return [replace(one, command=replace(one.command, name=one.command.name.removeprefix(begin))) for one in ours]


def _work(made: Iterable[Done], folder: Path) -> Iterator[tuple[str, Done]]:
    """Open, export, overlay and report finished slices and runs."""
    made = list(made)
    runs = [one.command for one in made if one.command.verb == "run"]
    for command in (one.command for one in made):
        if command.verb in ("slice", "run"):
            yield "open", _opened(command, folder)
            yield "export", run(_reading(command, "export", command.name, file="table.csv"), folder)
        if command.plane and (over := [one.name for one in runs if one.env == command.env]):
            yield "overlay", run(_reading(command, "overlay", command.name, *over[:2], *_source(command)), folder)
        if command.verb == "report":
            yield "report", run(_reading(command, "report", *command.words[1:-2]), folder)


def _source(command: Command) -> tuple[str, ...]:
    return ("--env", command.env[0]) if command.env[0].startswith("own.py") else ()


def _reading(command: Command, verb: str, *words: str, file: str = "") -> Command:
    """Return a command line that reads a result and writes beside it."""
    name = f"{WORKED}/{verb}-{command.name}"
    return Command(name, verb, (verb, *words, "--out", f"{name}/{file}" if file else name), command.env)


def _opened(command: Command, folder: Path) -> Done:
    """Open a slice or a run in Python, in a process of its own, and hold it against its arrays on disk."""
    ended = forked.alone(_open, command.verb, command.name, folder=folder, limits=LIMITS)
    return Done(command, ended.code, forked.last_words(ended.err), 0.0)


def _open(verb: str, name: str) -> None:
    import gradscape

    path = Path(name, f"{verb}.zarr")
    found = (gradscape.open_slice if verb == "slice" else gradscape.open_run)(path)
    dataset = getattr(found, "data", found)  # a noun of the package may hold the dataset
    raw = stored.arrays(path)
    wrong = [one for one in ("loss", "status", "grad", "x", "u", "v") if one in raw and not stored.same(
        raw[one], dataset[one].to_numpy())]  # fmt: skip
    if wrong:
        raise RuntimeError(f"{path} is read otherwise than it is on disk: {', '.join(wrong)}")


def _gone_on(made: Iterable[Done], folder: Path) -> Iterator[tuple[str, Done]]:
    """Give every command again that made a result, finished or not; a check keeps nothing."""
    for one in made:
        if one.command.verb != "check":
            what = "unfinished, again" if one.command.stop else f"finished {one.command.verb}, again"
            yield what, run(replace(one.command, drawn=False), folder)


def _other_numbers(found: Iterable[tuple[str, Done]], old: Path, folder: Path) -> Iterator[str]:
    """Name the reports of old slices that say other numbers than they said before."""
    for what, done in found:
        if what == "report" and done.code == 0:
            before = stored.contents(old / done.command.name.removeprefix(f"{WORKED}/report-"))
            if differ := stored.differences(before, stored.contents(folder / done.command.name)):
                yield f"{done.command.name}: {'; '.join(differ[:5])}"


def _name_bad(bad: Iterable[Done]) -> None:
    for one in bad:
        print(f"{one.outcome}: landscape {shlex.join(one.command.words)}\n  {one.said.strip()[-700:]}")


def main() -> None:
    """Do what is asked, in words or numbers on standard output."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    making = verbs.add_parser("make")
    making.add_argument("--out", type=Path, required=True)
    making.add_argument("--count", type=int, default=100)
    making.add_argument("--seed", type=int, default=0)
    for name in ("compare", "reuse"):
        other = verbs.add_parser(name)
        other.add_argument("old", type=Path)
        other.add_argument("new", type=Path)
    given = parser.parse_args()
    forked.load()
    os.environ["OMP_NUM_THREADS"] = "1"
    if given.verb == "make":
        bad = make(given.out.resolve(), given.count, given.seed)
    elif given.verb == "compare":
        bad = compare(given.old.resolve(), given.new.resolve())
    else:
        bad = reuse(given.old.resolve(), given.new.resolve())
    sys.exit(int(bool(bad)))


if __name__ == "__main__":
    main()
