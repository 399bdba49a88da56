"""Damage one file of a result, read it and go on with it, and hold what is read against the undamaged.

    python -m benchmarks.damage [--count 500] [--seed 0] [--kind slice --kind run] [--json]

Every kind of result is made once by the verbs. A copy of it gets one damage to one of its files, as disks, copies and
hands do it: a byte changed, cut, emptied, removed, grown, two chunks swapped, a value changed deep inside of JSON, a
folder or a loop in its place. Then a verb that reads it and the command that made it are run. Numbers must be right,
missing, or computed again to the same bits; or the result is refused in a line that names it, and where that line
recommends --force, the same command with --force makes the right numbers. Exit code 1 says that something else came
out.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import forked, results
from benchmarks.forked import Ended, Limits
from benchmarks.results import KINDS, Numbers

RIGHT, AGAIN, REFUSED = "right", "computed again", "refused by name"
GOOD = (RIGHT, AGAIN, REFUSED)
BAD = ("WRONG NUMBER", "left out unsaid", "refused without the name", "--force refused", "traceback", "other")
WAYS = ("flip", "cut", "empty", "remove", "grow", "swap", "edit", "folder", "loop")
ODD = (None, 0, 1, -1, 7, 1e300, "", "x", "[/b]", [], {}, [1], {"x": 1}, True, "float32", "int64")


@dataclass(frozen=True)
class Case:
    """What was done to which file of which kind, what was run after it, and what came of that."""

    kind: str
    way: str
    file: str
    command: str
    outcome: str
    said: str


def damage(chance: random.Random, file: Path) -> str:
    """Do one thing to a file, and say what."""
    content = file.read_bytes()
    others = [one for one in sorted(file.parent.iterdir()) if one.is_file() and one != file and _alike(one, file)]
    ways = [way for way in WAYS if (way != "swap" or others) and (way != "edit" or file.suffix == ".json")]
    ways += ["edit"] * 4 * (file.suffix == ".json") + ["swap"] * 4 * bool(others)
    way = chance.choice(ways if content else ["remove", "grow", "folder", "loop"])
    if way in ("remove", "folder", "loop"):
        file.unlink()
        if way == "folder":
            file.mkdir()
        elif way == "loop":
            file.symlink_to(file.name)
    elif way == "swap":
        other = chance.choice(others)
        theirs = other.read_bytes()
        other.write_bytes(content)
        file.write_bytes(theirs)
    elif way == "edit":
        file.write_text(json.dumps(edited(chance, json.loads(content))))
    elif way in ("cut", "flip"):
        at = chance.randrange(len(content))
        flipped = bytes([content[at] ^ chance.randint(1, 255)]) + content[at + 1 :]
        file.write_bytes(content[:at] + (flipped if way == "flip" else b""))
    else:
        file.write_bytes(content + chance.randbytes(chance.randint(1, 9)) if way == "grow" else b"")
    return way


def _alike(one: Path, other: Path) -> bool:
    """Say whether two files are of a kind: chunks of one array, pieces of one study."""
    return one.suffix == other.suffix and one.suffix in ("", ".npz") and one.name != "state"


def edited(chance: random.Random, value: Any) -> Any:
    """Change or remove something deep inside of a JSON value."""
    if isinstance(value, dict | list) and value and chance.randrange(5):
        key = chance.choice(sorted(value) if isinstance(value, dict) else range(len(value)))
        if chance.randrange(6):
            value[key] = edited(chance, value[key])
        else:
            del value[key]
        return value
    return chance.choice([odd for odd in ODD if odd != value])


class Trial:
    """The results of every kind, whole, under a folder, and what may be said of damaged copies of them."""

    def __init__(self, root: Path, limits: Limits | None = None) -> None:
        self.root, self.limits = root, limits or Limits()
        self._known: dict[tuple[str, str], tuple[dict[str, Numbers], str]] = {}

    def whole(self, name: str) -> Path:
        """Return the folder of a kind, made if it is not there."""
        folder, kind = self.root / name.replace(" ", "-"), KINDS[name]
        if not folder.exists():
            folder.mkdir(parents=True)
            for need in kind.needs:
                self._sound(self._run(need, folder), need)
            made = self._run(kind.make, folder, before=kind.stop or results.small)
            self._sound(made, kind.make, code=130 if kind.stop else 0)
        return folder

    def case(self, name: str, chance: random.Random) -> Iterator[Case]:
        """Damage a copy of a kind, read it, go on with it, and yield what came of either."""
        kind, damaged, folder = KINDS[name], self.root / "as-damaged", self.root / "damaged"
        whole = self.whole(name)
        _copy(whole, damaged)
        file = chance.choice(files(damaged / kind.where))
        way, named = damage(chance, file), str(file.relative_to(damaged))
        for command in ([chance.choice(kind.reads)] if kind.reads else []) + [kind.make]:
            _copy(damaged, folder)  # a verb that reads may go on with it, too
            outcome, said = self._outcome(name, command, folder)
            if outcome == RIGHT and command == kind.make and _content(folder / named) != _content(file):
                outcome = AGAIN
            yield Case(name, way, named, command, outcome, said)

    def _outcome(self, name: str, command: str, folder: Path) -> tuple[str, str]:
        ended = self._run(command, folder)
        outcome, said = self._judged(name, command, folder, ended)
        if outcome == REFUSED and "--force" in said and command == KINDS[name].make:
            again = f"{command} --force"
            forced, why = self._judged(name, command, folder, self._run(again, folder))
            if forced != RIGHT:
                return ("--force refused" if forced == REFUSED else forced), f"{said}\nwith --force: {why}"
        return outcome, said

    def _judged(self, name: str, command: str, folder: Path, ended: Ended) -> tuple[str, str]:
        """Return the outcome of a command on a damaged result, and what tells it."""
        said = ended.err.strip()
        if failure := forked.failure(ended):
            return (failure if failure in BAD else "other"), f"{failure}: {forked.last_words(said)}"
        if ended.code:
            last = said.splitlines()[-1] if said else ""
            named = KINDS[name].where in last or "`landscape " in last
            return (REFUSED if named else "refused without the name"), said
        wanted, wanted_out = self._wanted(name, command)
        found = self._numbers(folder)
        if wrong := results.wrong(found, wanted):
            return ("WRONG NUMBER" if not _says_so(said) else RIGHT), f"{', '.join(wrong)}\n{said}"
        if command == KINDS[name].make and (lost := results.missing(found, wanted)):
            return ("left out unsaid" if not _says_so(said) else RIGHT), f"{', '.join(lost)}\n{said}"
        if _printed(ended.out) != wanted_out and not _says_so(said):
            return "WRONG NUMBER", f"printed: {ended.out[:1000]}\nundamaged: {wanted_out[:1000]}\n{said}"
        return RIGHT, said

    def _wanted(self, name: str, command: str) -> tuple[dict[str, Numbers], str]:
        """Return the numbers after a command on the undamaged, which must be the same when it is run twice."""
        if (name, command) not in self._known:
            folder, kind = self.root / "undamaged", KINDS[name]
            _copy(self.whole(name), folder)
            ended = self._run(command, folder)
            if (command == kind.make or ended.code not in (0, 2)) and ended.code:
                raise RuntimeError(f"{command} ended with {ended.code}: {ended.err}")
            found = self._numbers(folder)
            self._known[name, command] = found, _printed(ended.out)
        return self._known[name, command]

    def _numbers(self, folder: Path) -> dict[str, Numbers]:
        forked.alone(_tell, str(folder), folder=self.root, limits=self.limits)
        found = json.loads((self.root / "told.json").read_text())
        return {name: Numbers(**one) for name, one in found.items()}

    def _run(self, command: str, folder: Path, before: Any = results.small) -> Ended:
        return forked.landscape(command.split(), folder, limits=self.limits, before=before)

    def _sound(self, ended: Ended, command: str, code: int = 0) -> None:
        if ended.code != code:
            raise RuntimeError(f"{command} ended with {ended.code}: {ended.err}")


def _tell(folder: str) -> None:
    found = results.numbers(Path(folder))
    told = {name: {"rows": one.rows, "whole": one.whole} for name, one in found.items()}
    Path("told.json").write_text(json.dumps(told))


def _says_so(said: str) -> bool:
    return any(word in said for word in ("damaged", "missing", "not sampled", "left out", "failed", "not reported"))


def _printed(out: str) -> str:
    """Return what was printed, of JSON what is the same every time."""
    try:
        return json.dumps(results.plain(json.loads(out)), sort_keys=True)
    except ValueError:
        return ""


def files(folder: Path) -> list[Path]:
    """Return every file under a folder."""
    return sorted(file for file in folder.rglob("*") if file.is_file())


def _content(file: Path) -> bytes | None:
    return file.read_bytes() if file.is_file() else None


def _copy(whole: Path, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole, folder, symlinks=True)


def table(cases: Sequence[Case]) -> str:
    """Return how many cases of each kind had which outcome."""
    counts = Counter((case.kind, case.outcome) for case in cases)
    shown = [*GOOD, *BAD]
    lines = [f"| result | {' | '.join(shown)} |", f"|---|{'---|' * len(shown)}"]
    kinds = list(dict.fromkeys(case.kind for case in cases))
    lines += [f"| {kind} | {' | '.join(str(counts[kind, outcome]) for outcome in shown)} |" for kind in kinds]
    return "\n".join(lines)


def main() -> None:
    """Print what damages came to, and every one that came to something else than it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=list(KINDS))
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    forked.load()
    kinds, cases = given.kind or list(KINDS), list[Case]()
    with tempfile.TemporaryDirectory() as root:
        trial = Trial(Path(root), Limits(cpu=120, clock=300))
        for number in range(given.count):
            for case in trial.case(kinds[number % len(kinds)], random.Random(f"{given.seed}-{number}")):
                cases.append(case)
                if case.outcome in BAD:
                    print(f"{number}: {case.outcome}: {case.way} {case.file}, then landscape {case.command}\n"
                          f"  {case.said[-900:]}", file=sys.stderr, flush=True)  # fmt: skip
    bad = [case for case in cases if case.outcome in BAD]
    if given.json:
        print(json.dumps([case.__dict__ for case in cases]))
    else:
        print(f"{given.count} files damaged, {len(cases)} commands\n\n{table(cases)}")
    sys.exit(int(bool(bad)))


if __name__ == "__main__":
    main()
