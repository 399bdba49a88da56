"""Write the tables of the gallery's records into README and the pages, between <!-- NAME --> and <!-- /NAME -->.

    python -m docs.pages.tables [--check]

With --check it writes nothing, and exits with code 1 if a page differs from the records. A scene without a record, or
with a model that has changed since, has a row that says so.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, cast

from benchmarks import advice

from gradscape.envs.registry import entries, environment_class
from gradscape.gallery.figures import read_figures
from gradscape.gallery.files import DATA, DEVICES
from gradscape.gallery.league import read_league
from gradscape.gallery.paper import read_paper
from gradscape.jobs.report import Report, environments_markdown
from gradscape.landscapes.checks.causes import causes
from gradscape.landscapes.convert import from_json
from gradscape.landscapes.measures.census import Census
from gradscape.landscapes.measures.verdict import FLAT
from gradscape.landscapes.statistics import Estimate
from gradscape.landscapes.storage.records import read_json
from gradscape.optim.league import League, SceneStandings
from gradscape.optim.options import OURS, PAPER, defaults
from gradscape.optim.registry import methods, optimizer_class
from gradscape.optim.statistics import Lead, MeanRank
from gradscape.studies.claims import CLAIMS, Claim, Shortfall
from gradscape.studies.extremes import ExtremesRecord, Limit
from gradscape.studies.fidelity import FidelityRecord
from gradscape.studies.kept import file_name, read_study
from gradscape.studies.model import MeasuredPart, ModelRecord
from gradscape.studies.variants import StudyRecord

from .text import cell, table

ROOT = Path(__file__).parents[2]
FLOORS = DATA / "floors.json"  # which benchmarks/symmetry.py writes
UNMEASURED, MISSING = "not measured since the scene changed", "not measured"
UNCOUNTED = "no census since the verdicts changed"
SURFACES = {  # of README: what a slice may be, and the words that say so, of which a slice has one at most
    "very smooth": ("very smooth",),
    "smooth with local minima": ("smooth with local minima",),
    "rugged": ("rugged", "extremely rugged"),
}
OTHERS = {"with jumps": ("discontinuous",), "gradients follow": ("gradients follow",)}
OFTEN = 0.1  # share of slices from which on a word is in the table of presets
Record = Mapping[str, Any]


def scenes() -> list[str]:
    """Return our simulated scenes, without functions, which have one fidelity, and without engines of others."""
    return sorted(
        name for name, one in entries().items() if not one.extra and len(environment_class(name).fidelities) > 1
    )


def present(record: Record) -> bool:
    """Say whether a record is from the present version of its scene's model."""
    known = record["identity"]
    return bool(known["model_version"] == environment_class(known["objective"]).version_on(known["engine"]))


def kept(pattern: str, scene: str, data: Path = DATA) -> list[Record] | str:
    """Return a scene's records of its present model, such as "census/{}-{}.json", or the reason for none."""
    files = (data / pattern.format(scene, device) for device in DEVICES)
    records = [read_json(file) for file in files if file.exists()]
    return [one for one in records if present(one)] or (UNMEASURED if records else MISSING)


def studies(kind: str, scene: str, data: Path = DATA) -> list[StudyRecord] | str:
    """Return a scene's studies of a kind for its present model, or the reason for none."""
    files = (data / "studies" / file_name(scene, device, kind) for device in DEVICES)
    found = [read_study(file, kind) for file in files if file.exists()]
    return [one for one in found if present({"identity": one.identity})] or (UNMEASURED if found else MISSING)


def censuses() -> str:
    """The share of a scene's slices that each verdict fits, among those that are not flat."""
    rows = []
    for scene in scenes():
        said, found = _paper_words(scene), _census(scene)
        if isinstance(found, str):
            rows.append([f"`{scene}`", "", "", found, ", ".join(said)])
            continue
        measured = [word for word, one in found.words.items() if word != FLAT and one.value > 0]
        flat = str(len(found.slices) - found.solid)
        paper = ", ".join(_share(found, word) for word in said)
        rows.append([f"`{scene}`", str(len(found.slices)), flat, _most_first(found, measured), paper])
    head = ("environment", "slices", "flat", "measured: share of the other slices (95 % interval)", "the paper's words")
    return table(head, rows)


def short_censuses() -> str:
    """README's table of the censuses: the number of slices that are not flat, and the share of each verdict."""
    rows, left = [], []
    for scene in scenes():
        found = _census(scene)
        if isinstance(found, str):
            left.append(f"`{scene}`")
            continue
        surface, other = ([found.share(words) for words in columns.values()] for columns in (SURFACES, OTHERS))
        known = found.share([word for words in SURFACES.values() for word in words])
        unknown = Estimate(1 - known.value, 1 - known.high, 1 - known.low)
        cells = [str(found.solid), *map(_interval, [*surface, unknown, *other])]
        rows.append([f"`{scene}`", *cells, ", ".join(_paper_words(scene))])
    shown = table(("environment", "slices", *SURFACES, "none of the three", *OTHERS, "the paper says"), rows)
    return f"{shown}\n\nNo census since the verdicts changed: {', '.join(left)}." if left else shown


def presets() -> str:
    """The verdicts on slices with our settings and with the paper's, where these differ."""
    rows = []
    for scene in scenes():
        if not environment_class(scene).presets.get("paper"):
            continue
        said, cells = _paper_words(scene), list[str]()
        for settings in ("default", "paper"):
            found = _census(scene, f"presets/{{}}-{{}}-{settings}.json")
            if isinstance(found, str):
                cells += ["", found]
                continue
            often = [word for word, one in found.words.items() if one.value >= OFTEN or word in said]
            cells += [found.fidelity, _most_first(found, often)]
        rows.append([f"`{scene}`", cells[0], cells[1], cells[3], ", ".join(said)])
    head = ("environment", "fidelity", "with our settings", "with `--preset paper`", "the paper's words")
    return table(head, rows)


def _census(scene: str, pattern: str = "census/{}-{}.json") -> Census | str:
    found = kept(pattern, scene)
    if isinstance(found, str):
        return UNCOUNTED if found == MISSING else found
    return from_json(Census, found[0])


def _paper_words(scene: str) -> tuple[str, ...]:
    words = read_paper().words
    return words[scene].words if scene in words else ()


def _most_first(found: Census, words: Sequence[str]) -> str:
    return ", ".join(_share(found, word) for word in sorted(words, key=lambda word: -found.words[word].value))


def _share(found: Census, word: str) -> str:
    return f"{word} {_interval(found.words[word])}"


def _interval(share: Estimate) -> str:
    if not math.isfinite(share.value):
        return ""
    value, low, high = (100 * one for one in (share.value, share.low, share.high))
    return f"{value:.0f} % ({low:.0f} to {high:.0f})" if math.isfinite(low) else f"{value:.0f} % of all"


def kept_league() -> League:
    """Return the league of the gallery's data."""
    found = read_league(DATA)
    assert found is not None  # it is a part of every checkout
    return found


def races(head: Sequence[str], cells: Callable[[SceneStandings], Sequence[str]], *more: Sequence[str]) -> str:
    """Return a table with a row for each race of the league, and more rows below them."""
    rows = [[f"`{one.env}`", one.fidelity, *cells(one)] for one in kept_league().scenes]
    return table(("environment", "fidelity", *head), [*rows, *more])


def short_league() -> str:
    """README's table of the league: the best mean rank, and how many other methods it is ahead of."""
    scenes = kept_league().scenes
    (budget,), (forwards,) = {one.budget for one in scenes}, {f"{one.equal_cost.forwards:.0f}" for one in scenes}
    ahead = "is ahead of"
    costs = (f"best mean rank, {budget} episodes", ahead, f"best mean rank, {forwards} forward equivalents", ahead)

    def cells(one: SceneStandings) -> list[str]:
        rest = f"{len(one.not_told_from_random)} of {len(one.methods) - 1}"
        return [*_lead(one.lead, one.ranks), *_lead(one.equal_cost.lead, one.equal_cost.ranks), rest]

    return races((*costs, "not distinguishable from random search"), cells) + _changed(scenes)


def _changed(scenes: Sequence[SceneStandings]) -> str:
    """Name the scenes whose model has changed since their race, or return nothing."""
    names = [f"`{one.env}`" for one in scenes if not present({"identity": one.identity})]
    return f"\nRaced with a model that has changed since: {', '.join(names)}.\n" if names else ""


def _lead(lead: Lead, ranks: Sequence[MeanRank]) -> list[str]:
    """Return the cells of the methods with the best mean rank, in bold only if one method is first."""
    others, best = len(ranks) - 1, ranks[0].rank
    name = f"{', '.join(f'`{one.method}`' for one in ranks if one.rank == best)} {best:.2f}"
    if lead.is_first:
        return [f"**{name}, first**", f"all {others} (p at most {lead.p:.2g})"]
    return [name, f"{others - len(lead.rivals)} of {others}"]


def league() -> str:
    """The mean ranks of all methods in all scenes, at equal episodes and at equal forward equivalents."""
    found = kept_league()
    cost = {one.method: one.rank for one in found.overall_at_equal_cost}
    whole = ["all scenes", "", *(f"{one.rank:.2f} / {cost[one.method]:.2f}" for one in found.overall)]
    ranks = races(found.methods, lambda one: [_ranks(one, name) for name in found.methods], whole)
    return ranks + _changed(found.scenes)


def _ranks(scene: SceneStandings, method: str) -> str:
    """Return a method's mean ranks at equal episodes and at equal forward equivalents, in bold where it is first."""
    (rank,) = (one.rank for one in scene.standings if one.method == method)
    both = ((rank, scene.lead), (scene.cost_rank(method).rank, scene.equal_cost.lead))
    marked = ("**" if lead.is_first and lead.method == method else "" for _, lead in both)
    return " / ".join(f"{mark}{one:.1f}{mark}" for mark, (one, _) in zip(marked, both, strict=True))


def rivals() -> str:
    """The methods not distinguishable from the one with the best mean rank, and those not from random search."""
    costs = ("best mean rank at equal episodes", "best mean rank at equal forward equivalents")
    return races(
        (*costs, "not distinguishable from random search"),
        lambda one: [_rivals(one.lead), _rivals(one.equal_cost.lead), ", ".join(one.not_told_from_random) or "none"],
    )


def _rivals(lead: Lead) -> str:
    if lead.is_first:
        return f"**`{lead.method}`**, first: p at most {lead.p:.2g}"
    return f"`{lead.method}`, not distinguishable from {', '.join(lead.rivals)} (p up to {lead.p:.2g})"


def method_defaults() -> str:
    """The source of each default of a method."""
    rows = []
    for name in methods():
        known: dict[str, list[str]] = {}
        for one in defaults(optimizer_class(name).Options):
            known.setdefault(one.source, []).append(f"`{one.option}` {one.value}")
        said = [", ".join(known.pop(source, ())) for source in (PAPER, OURS)]
        theirs = "; ".join(f"{source}: {', '.join(options)}" for source, options in known.items())
        rows.append([f"`{name}`", said[0], theirs, said[1]])
    return table(("method", "the paper's", "a library's or its authors'", "ours"), rows)


def margins() -> str:
    """How near standard's time step is to the longest stable one, by precision."""
    rows = []
    for scene in scenes():
        found = studies("extremes", scene)
        if isinstance(found, str):
            rows.append([f"`{scene}`", *[""] * 4, found, "", ""])
            continue
        limits = [
            (one, limit)
            for one in found if isinstance(one, ExtremesRecord)
            for limit in one.limits if limit.setting == "dt"
        ]  # fmt: skip
        rows += [[f"`{scene}`", one.device, *_margin(limit)] for one, limit in limits]
    step = ("step of standard [s]", "longest stable step [s]", "margin", "beyond", "95 % error")
    return table(("scene", "device", "precision", *step), rows)


def _margin(limit: Limit) -> list[str]:
    base, stable = limit.base, "" if limit.stable is None else f"{limit.stable:.3g}"
    (own,) = (cell for cell in limit.scanned if cell.values == (base,))
    error = "" if own.error is None else f"{100 * own.error:.2g} %"
    if limit.failed is None:
        return [limit.precision, f"{base:.3g}", f"at least {stable}", "", "", error]
    margin = "" if limit.margin is None else f"{limit.margin:.2f}"
    return [limit.precision, f"{base:.3g}", stable, margin, limit.beyond, error]


def fidelities() -> str:
    """Whether draft and standard keep their claims against the reference, and their numerical floors."""
    rows = []
    for scene, claim in product(scenes(), CLAIMS):
        *cells, kept = _fidelity(scene, claim)
        rows.append([f"`{scene}`", claim.name, *cells, *_floor(scene, claim.name), kept])
    floor = ("numerical floor", "cosine of replicas")
    return table(("scene", "fidelity", "device", "rank", "cosine", "95 % error", "ms", *floor, "claim"), rows)


def _floor(scene: str, fidelity: str, file: Path = FLOORS) -> list[str]:
    """Return the cells of a fidelity's floor of losses and gradients, for the present scene and settings."""
    now = environment_class(scene).fidelities[fidelity].record()
    measured = [
        row["floor"]
        for row in (read_json(file)["floors"] if file.exists() else ())
        if (row["env"], row["identity"]["settings"]) == (scene, now) and present(row)
    ]
    if not measured:
        return ["not measured", ""]
    share, cosine = measured[-1]["share"], measured[-1]["cosine"]
    low, high = (f"{100 * share[end]:.2g}" for end in ("low", "high"))
    return [f"{100 * share['value']:.2g} % ({low} to {high})", _number(cosine and cosine["value"], 3)]


def _fidelity(scene: str, claim: Claim) -> list[str]:
    """Return the cells of a fidelity, from the variant with its present settings."""
    found = studies("fidelity", scene)
    now = environment_class(scene).fidelities[claim.name]
    for record in found if not isinstance(found, str) else ():
        assert isinstance(record, FidelityRecord)
        known = {key: record.identity[key] for key in ("device", "engine", "options")}
        for one in record.variants:
            same = all(getattr(one, key) == value for key, value in known.items())
            if same and replace(one.fidelity, name=claim.name) == now:
                measured = one.comparison
                lack, error = Shortfall.of(measured, claim), measured.loss_error.p95_relative.value
                return [
                    one.device, _number(measured.spearman.value, 3), _number(measured.gradient.cosine.value, 3),
                    "none" if error is None else f"{100 * error:.0f} %" if error >= 0.1 else f"{100 * error:.2g} %",
                    f"{1e3 * one.seconds:.3g}", "kept" if lack.kept else f"short in {lack.by}",
                ]  # fmt: skip
    return [*[""] * 5, found if isinstance(found, str) else UNMEASURED]


def accuracy() -> str:
    """The table in BENCHMARKS.md: time and error of draft and standard."""
    rows = []
    for scene in scenes():
        cells = [_fidelity(scene, claim) for claim in CLAIMS]
        numbers = [number for _, _, _, error, ms, _ in cells for number in (ms, error)]
        rows.append([f"`{scene}`", ", ".join(dict.fromkeys(one[0] for one in cells)), *numbers])
    return table(("scene", "device", "draft [ms]", "error", "standard [ms]", "error"), rows)


def parts() -> str:
    """What each part of a scene's model contributes: the change of losses without it, its cost, and the verdict."""
    rows = []
    for scene in sorted(entries()):
        found = studies("model", scene)
        measured = {} if isinstance(found, str) else {one.name: one for one in cast(ModelRecord, found[0]).parts}
        for part in environment_class(scene).model_parts:
            one = measured.get(part.name)
            cells = [*[""] * 4, UNMEASURED] if one is None or one.options != dict(part.options) else _part(one)
            rows.append([f"`{scene}`", part.name, f"{part.change}{' (missing now)' if part.missing else ''}", *cells])
    return table(("scene", "part", "changed to", "95 % of losses change by", "rank", "cosine", "time", "verdict"), rows)


def _part(one: MeasuredPart) -> list[str]:
    found, cost = one.comparison, one.cost.value
    moved = found.loss_error.p95_relative.value
    return [
        "none" if moved is None else f"{100 * moved:.2g} %",
        *(_number(value.value, 2) for value in (found.spearman, found.gradient.cosine)),
        "none" if cost is None else f"{100 * (cost - 1):+.0f} %",
        one.verdict,
    ]


def _number(value: float | None, digits: int) -> str:
    return "none" if value is None else f"{value:.{digits}f}"


def measured() -> str:
    """The verdicts on the gallery's slices, from their reports."""
    files = [DATA / figure.id / "report.json" for figure in read_figures()]
    return environments_markdown([Report.read(file) for file in files if file.exists()])


def known_causes() -> str:
    """Return a row for each cause of wrong gradients: its name, whether a check fails or warns, and what to try."""
    rows: dict[str, tuple[set[str], list[str]]] = {}
    for one in causes():
        ends, remedies = rows.setdefault(one.name, (set(), []))
        ends |= {f"{signature.outcome}s" for signature in one.signatures}
        remedy = one.remedy.format(best_step=1e-5)
        if not any(said.startswith(remedy.rstrip(".")) for said in remedies):
            remedies.append(remedy)
    lines = [(name, ", ".join(sorted(ends)), cell(" ".join(remedies))) for name, (ends, remedies) in rows.items()]
    return table(["cause", "check", "what to try"], lines)


TABLES: dict[tuple[str, str], Callable[[], str]] = {  # by page and name
    ("README.md", "censuses"): short_censuses,
    ("README.md", "league"): short_league,
    ("README.md", "advice"): advice.prose,
    ("docs/advice.md", "advice"): advice.score_table,
    ("docs/advice.md", "advised"): advice.scene_table,
    ("docs/races.md", "league"): league,
    ("docs/races.md", "rivals"): rivals,
    ("docs/races.md", "defaults"): method_defaults,
    ("BENCHMARKS.md", "accuracy"): accuracy,
    ("docs/measured.md", "measured"): measured,
    ("docs/measured.md", "censuses"): censuses,
    ("docs/measured.md", "presets"): presets,
    ("docs/measured.md", "margins"): margins,
    ("docs/fidelities.md", "fidelities"): fidelities,
    ("docs/parts.md", "parts"): parts,
    ("docs/measures.md", "causes"): known_causes,
}


def settle(*, check: bool) -> Iterator[str]:
    """Write all tables, or only check them, and yield the pages that differ."""
    for (page, name), wanted in TABLES.items():
        file = ROOT / page
        marks = (f"<!-- {name} -->\n\n", f"\n<!-- /{name} -->")
        before, rest = file.read_text().split(marks[0])
        text, after = rest.split(marks[1])
        if text != (found := wanted()):
            yield f"{page}: {name}"
            if not check:
                file.write_text(before + marks[0] + found + marks[1] + after)


def main() -> None:
    """Print the tables that differed from the records; exit with code 1 if one still does."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing")
    asked = parser.parse_args()
    differed = list(settle(check=asked.check))
    print(*differed, sep="\n")
    sys.exit(int(asked.check and bool(differed)))


if __name__ == "__main__":
    main()
