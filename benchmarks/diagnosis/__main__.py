"""Examine `gs.check` by planted defects and healthy awkward functions, and hold it against goals.

    python -m benchmarks.diagnosis [--only KIND ...] [--peers] [--json FILE]

Defects are found where the check does not pass. Where the gradient is right and useless, a warning of the right cause
is enough. A cause is named rightly where it is the first diagnosis, a region where the rule names its parameters and
their edges. Slabs of 2 to 40 % of the box with the wrong sign, across a parameter and at an angle, show the power.
`--only` takes kinds, `healthy` and `slabs`. `--peers` prints what other gradient checkers find of the same cases. The
exit code is 1 where a goal is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import warp as wp

from .catalogue import defects, healthy_functions
from .examine import WIDTHS, Result, Slabs, examine, power
from .peers import ask_peers, show_peers
from .tables import Share, table

GOALS = {"found": 0.97, "cause": 0.85, "place": 0.85}  # shares of what there is
SLAB = 0.05  # of the box
SLABS_FOUND = (34, 31)  # of 36 across a parameter, and at an angle: of 95 %, fewer are found once in a hundred runs


def by_kind(results: Sequence[Result]) -> str:
    """Return the table of the defects by kind, with what all come to at the end."""
    rows = []
    for kind in [*dict.fromkeys(one.kind for one in results), "all"]:
        group = [one for one in results if kind in (one.kind, "all")]
        shares = (Share.among(getattr(one, field) for one in group) for field in GOALS)
        rows.append((kind, *map(str, shares), f"{sum(one.seconds for one in group):.1f}"))
    return table(("kind", "found", "cause", "parameter or region", "seconds"), rows)


def missed(results: Sequence[Result], slabs: Sequence[Slabs]) -> list[str]:
    """Return the goals that are missed, in words."""
    sick, failed = [one for one in results if not one.healthy], [one.case for one in results if _wrongly_failed(one)]
    words = [
        f"{field}: {share}, and the goal is {goal:.0%}"
        for field, goal in GOALS.items()
        if not (share := Share.among(getattr(one, field) for one in sick)).reaches(goal)
    ]
    words += [f"healthy and failed: {', '.join(failed)}"] * bool(failed)
    for one in slabs:
        goal = SLABS_FOUND[one.tilted]
        if one.width == SLAB and one.found < goal:
            where = " at an angle" if one.tilted else ""
            words.append(f"slabs of {one.width:.0%}{where}: {one.found} of {one.tried} found, and the goal is {goal}")
    return words


def _wrongly_failed(result: Result) -> bool:
    return result.healthy and not result.passed


def describe(result: Result) -> str:
    """Return a case that came out wrong, in a line; empty for one that came out right."""
    if _wrongly_failed(result):
        return f"{result.case}: healthy, and failed: {result.said}"
    if result.healthy:
        return ""
    lacks = [field for field in GOALS if getattr(result, field) is False]
    return f"{result.case}: not {', '.join(lacks)}; said: {result.said}" if lacks else ""


def progress(text: str) -> None:
    """Show how far it is, on a terminal."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def examine_all(only: Sequence[str]) -> list[Result]:
    """Examine the cases of some kinds, all by default."""
    chosen = [case for case in [*defects(), *healthy_functions()] if not only or case.kind in only]
    results = []
    for k, case in enumerate(chosen):
        progress(f"{k + 1} of {len(chosen)}: {case.name}")
        results.append(examine(case))
        if wrong := describe(results[-1]):
            progress("")
            print(wrong, flush=True)
    progress("")
    return results


def measure_power(only: Sequence[str]) -> list[Slabs]:
    """Measure the power by slabs of each width, unless other kinds are asked for."""
    if only and "slabs" not in only:
        return []
    found = [power(width, tilted, progress) for tilted in (False, True) for width in WIDTHS]
    progress("")
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Examine, print the tables, and return 1 where a goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = sorted({case.kind for case in defects()})
    parser.add_argument("--only", nargs="+", metavar="KIND", default=[], choices=[*kinds, "healthy", "slabs"])
    parser.add_argument("--peers", action="store_true", help="run other gradient checkers on the same cases")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep all results in a file")
    asked = parser.parse_args(words)
    wp.config.log_level = wp.LOG_WARNING
    results, slabs = examine_all(asked.only), measure_power(asked.only)
    show(results, slabs)
    kept = {"cases": [asdict(one) for one in results], "slabs": [asdict(one) for one in slabs]}
    if asked.peers:
        answers = ask_peers(asked.only, progress)
        print(f"\n{show_peers(results, answers)}")
        kept["peers"] = [asdict(one) for one in answers]
    if asked.json:
        asked.json.write_text(json.dumps(kept, indent=1))
    short = missed(results, slabs)
    print("\n" + ("\n".join(f"missed: {one}" for one in short) if short else "All goals are reached."))
    return 1 if short else 0


def show(results: Sequence[Result], slabs: Sequence[Slabs]) -> None:
    """Print what came out of the defects, the healthy functions and the slabs."""
    sick, well = [one for one in results if not one.healthy], [one for one in results if one.healthy]
    if sick:
        print(f"\n{by_kind(sick)}")
    if well:
        passed = Share.among(one.passed for one in well)
        slowest = max(results, key=lambda one: one.seconds)
        print(f"\nhealthy functions passed: {passed}, in {sum(one.seconds for one in well):.1f} s")
        print(f"slowest: {slowest.case}, {slowest.seconds:.1f} s")
    if slabs:
        rows = [
            (
                f"{one.width:.0%}",
                "at an angle, of 10 parameters" if one.tilted else "across one of 2 parameters",
                f"{one.found}/{one.tried}",
                f"{one.seconds / one.tried:.2f}",
            )
            for one in slabs
        ]
        print(f"\n{table(('slab', 'where', 'found', 'seconds each'), rows)}")


if __name__ == "__main__":
    sys.exit(main())
