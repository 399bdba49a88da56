"""Records of studies that fill their figures: each setting there is, in each precision, long names, many rows."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import xarray as xr

from gradscape.envs.records import Fidelity
from gradscape.jobs.check import CheckReport
from gradscape.jobs.league import simulated_scenes
from gradscape.landscapes.checks.diagnosis import Diagnosis, Region
from gradscape.landscapes.checks.examination import Share, could_be_missed
from gradscape.landscapes.checks.slopes import Kind
from gradscape.landscapes.checks.usefulness import UNKNOWN, Usefulness
from gradscape.landscapes.draw import style
from gradscape.landscapes.measures.card import Card, CardSlice, ClosedFormError, FailedCheck, Grade
from gradscape.landscapes.measures.census import MEASURES, Census, CensusDesign, SurveyedSlice, conclude
from gradscape.landscapes.measures.floor import Floor
from gradscape.landscapes.measures.hessian import Eigenpair, Hessian
from gradscape.landscapes.measures.verdict import WORDS
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.statistics import Estimate, share
from gradscape.optim.registry import methods
from gradscape.studies.convergence import (
    ConvergenceRecord,
    ConvergenceRule,
    Level,
    Move,
    Remainder,
    SettingConvergence,
)
from gradscape.studies.divergence import ComparedDistribution, Distance, Distributions
from gradscape.studies.extremes import ExtremesRecord, Limit, StabilityMap
from gradscape.studies.fidelity import FidelityRecord
from gradscape.studies.order import Shapes
from gradscape.studies.samples import Bootstrap
from gradscape.studies.stability import STABLE, Cell
from gradscape.studies.symmetry import MeasuredReplica, SymmetryRecord
from gradscape.studies.updates import ALONG, RANDOM, Outcomes, UpdatesRecord

from ....made_studies import VARIANTS, fidelities, variant

MEASURED = {"device": "cuda", "engine": "warp", "created": "2026-11-21"}
COMMAND = "landscape {} triple-move --fidelity reference --device cuda --points 64 --out studies/triple-move-reference"


def league() -> xr.Dataset:
    """Return the ranks of every method in every scene, all ranks between best and worst; one did not run."""
    scenes, racers = [*(f"{name} (reference)" for name in simulated_scenes()), "all scenes"], methods()
    rank = 1.0 + np.add.outer(np.arange(len(scenes)), np.arange(len(racers))) % len(racers)
    rank[0, -1] = np.nan
    parts = {"rank": rank, "rank_low": rank - 0.5, "rank_high": rank + 0.5}
    return xr.Dataset(
        {name: (("scene", "method"), value) for name, value in (parts | {"first": rank == 1.0}).items()},
        {"scene": scenes, "method": list(racers)},
        {"title": "League of all methods · 1000 episodes · 10 seeds", "seeds": "10", "command": COMMAND},
    )


def near(value: float) -> Bootstrap:
    return Bootstrap(value, 0.8 * value, 1.3 * value)


def refined(name: str, widths: list[float]) -> SettingConvergence:
    """Return a setting whose observed order is not the designed one, with a floor."""
    levels = tuple(Level(f"reference-{name}-x{width:.3g}", width, Fidelity(name, width), 1.0) for width in widths)
    moves = tuple(
        Move(coarse.name, fine.name, fine.width, near(coarse.width), near(9 * coarse.width), near(0.9), near(0.1), 64)
        for coarse, fine in pairwise(levels)
    )
    shapes, verdict = Shapes(monotone=40, oscillating=12, growing=11, still=1), "converges"
    order = Bootstrap(1.21, -0.35, 2.42)
    return SettingConvergence(
        name, levels, moves, verdict, order, (1.0,) * 64, shapes, 2.0, min(widths) / 3, near(0.02), False, None
    )  # fmt: skip


def convergence() -> ConvergenceRecord:
    """Return a study of every setting that has a panel, of a scene that is chaotic."""
    steps = [2e-5 / 2**level for level in range(5)]
    others = [refined(one, [1.5, 1.0, 2 / 3, 0.5]) for one in ("resolution", "particles", "joint")]
    settings = (refined("dt", steps), *others)
    names = ("draft", "standard", *(one.levels[-1].name for one in settings), "reference-float32")
    far = Distance(near(0.4), near(0.3))
    apart = Distributions(
        16, 64, 0.01, far, {"kolmogorov": 0.2, "wasserstein": 0.1},
        tuple(ComparedDistribution(name, far, ("kolmogorov", "wasserstein")) for name in names),
    )  # fmt: skip
    return ConvergenceRecord(
        env="triple-move", reference="reference", points=64, seed=0, loss_unit="J", spread=12.3, settings=settings,
        rule=ConvergenceRule(near(0.05), near(0.02), "resolution", False, ("dt", "resolution", "particles", "joint")),
        remainders=(Remainder("standard", near(0.1), near(0.4)), Remainder("reference", near(0.004), near(0.02))),
        divergence=None, distributions=apart, refused=(), identity={}, provenance=MEASURED,
        command=COMMAND.format("study convergence"),
    )  # fmt: skip


def symmetry() -> SymmetryRecord:
    """Return a study of replicas with long names, one of which is not known well."""
    names = ("grid moved by 0.33, 0.67 cells", "other particles", "time steps 2 % shorter", "one cell less across")
    near, unknown = Estimate(0.02, 0.013, 0.041), Estimate(0.0, float("nan"), float("nan"))
    replicas = tuple(
        MeasuredReplica(name, near if number else unknown, Bootstrap(0.99, 0.98, 1.0), Estimate(0.9, 0.8, 0.95), 0.1, 0)
        for number, name in enumerate(names)
    )
    return SymmetryRecord(
        env="swing-stiffness", fidelity="standard", points=64, seed=0, loss_unit="m", refused=(), identity={},
        floor=Floor(names, 64, 0, 0.02, 1.0, near, Estimate(0.9, 0.8, 0.95)), replicas=replicas, provenance=MEASURED,
        command=COMMAND.format("study symmetry"),
    )  # fmt: skip


def updates() -> UpdatesRecord:
    """Return updates of which some fail and some end far off."""
    losses = np.array([*np.geomspace(0.5, 2.0, 60), 4e4, np.nan])
    both = [Outcomes.of(name, losses * (1 + k), before=1.0, zero=3.0) for k, name in enumerate((ALONG, RANDOM))]
    return UpdatesRecord(
        env="cartpole with policy mlp:32x32", fidelity="standard", points=62, seed=0, loss_unit="m", refused=(),
        identity={}, provenance=MEASURED, command=COMMAND.format("study updates"), through="training/step-60.pt",
        before=1.0, noise=0.01, rate=1e-3, length=0.01, zero=3.0, along=both[0], random=both[1],
        lower=Estimate(0.9, 0.8, 0.95), unknown=0, clamped=2,
    )  # fmt: skip


def limit(name: str, precision: str, failed: float | None) -> Limit:
    """Return a limit whose values span decades; `failed` is the factor from which they fail."""
    factors = np.geomspace(1e-3, 1e3, 13)
    scanned = [Cell((f,), "NONFINITE" if failed and f >= failed else "accurate", 1.0, error=f**2 / 50) for f in factors]
    stable = max(cell.values[0] for cell in scanned if cell.stable)
    return Limit(name, "s", precision, "largest", 1.0, stable, failed, "NONFINITE", 1.0, 2.0, (), tuple(scanned))


def stability_map(x: str, y: str, precision: str) -> StabilityMap:
    """Return a map in which every outcome occurs, over decades of both settings."""
    values, outcomes = tuple(np.geomspace(1e-6, 1e3, 9).tolist()), list(style.OUTCOMES)
    cells = [
        Cell((a, b), outcomes[(row + column) % len(outcomes)], 1.0)
        for row, b in enumerate(values) for column, a in enumerate(values)
    ]  # fmt: skip
    assert {cell.outcome for cell in cells} > set(STABLE)
    edge = tuple((b, 10.0, 11.0) for b in values[2:])
    accurate = tuple((b, 0.1, 0.11) for b in values[2:])
    return StabilityMap(x, y, ("s", "1/m"), precision, (1.0, 1.0), values, values, tuple(cells), edge, accurate)


def extremes() -> ExtremesRecord:
    """Return a study of as many settings as a scene has, and of two pairs of them, in both precisions."""
    settings = {"dt": 10.0, "resolution": None, "particles": None, "tool_friction": 100.0, "yield_stress": 1e3,
             "softness": 30.0, "gravity": 300.0}  # fmt: skip
    pairs = (("dt", "resolution"), ("yield_stress", "tool_friction"))
    both = ("float32", "float64")
    return ExtremesRecord(
        env="triple-move", fidelity="reference", reference="reference-dt-x0.5", points=64, seed=0, width=0.01,
        loss_unit="J", tolerance=0.1, limits=tuple(limit(*one, failed) for *one, failed in
                                   ((name, kind, failed) for kind in both for name, failed in settings.items())),
        maps=tuple(stability_map(*pair, kind) for kind in both for pair in pairs),
        refused=(), identity={}, provenance=MEASURED, command=COMMAND.format("study extremes"),
    )  # fmt: skip


def mixed() -> FidelityRecord:
    """Return a search among dozens of mixed variants, half of which are on the front."""
    settings = [
        f"dt-x{2 ** (k % 5)} resolution-{64 - k} particles-x{1 / (1 + k):.2g} float32 on warp" for k in range(24)
    ]
    rows = [
        variant(f"standard {said}", 10 * 0.8**k, 0.001 * 1.3**k * (1 + k % 2), "mixed")
        for k, said in enumerate(settings)
    ]
    return fidelities([*(one for one in VARIANTS if one.changed == "named"), *rows], "triple-move")


def card() -> Card:
    """Return a report card of three scenes, one engine of which is not installed."""
    u = np.linspace(0, 1, 9)
    loss = u[:, None] ** 2 + u**2
    slope = 2 * np.stack(np.broadcast_arrays(u, u[:, None]), axis=-1)
    where = {
        "u": u,
        "v": u,
        "loss": loss,
        "status": np.zeros((9, 9), int),
        "labels": ("speed x [m/s]", "speed y [m/s]"),
    }
    slices = {n: CardSlice(**where, slope=(1 - n) * slope, loss_unit="m²") for n in (0, 2, 3)}  # type: ignore[arg-type] # each of its kind
    names = (("drop", "an engine"), ("drop", "another"), ("flight", "an engine"), ("a slide on a rough floor", "third"))
    held = {0: grade(judged=64), 1: grade(missing="pip install another"), 2: grade(wrong=21), 3: grade(judged=20)}
    grades = [replace(held[n], scene=scene, engine=engine) for n, (scene, engine) in enumerate(names)]
    return Card(tuple(grades), "2030-01-01", "cpu", "landscape card", slices)


def grade(wrong: int = 0, judged: int = 64, missing: str = "") -> Grade:
    """Return a grade by how many of so many points are wrong, of 64 that were drawn."""
    found = share(wrong, judged)
    counted = Share(wrong, judged, 64, found.low, found.high, could_be_missed(judged))
    region = Region("speed x below 0.3", ("speed x",), 0.03, 64)
    what = f"the gradient has the wrong sign at {wrong} of {judged} points"
    told = Diagnosis("sign", "fail", "certain", what, "Look for a minus that is one too many.", ("speed x",), region)
    broken = FailedCheck("gradient", f"wrong at {counted.describe()}", what)
    return Grade(
        scene="drop", engine="an engine", env="bowl", fidelity="draft", options={"solver": "fast"}, dims=["0", "1"],
        versions={} if missing else {"engine": "1.2.3"}, missing=missing, power=0.05,
        share=None if missing else counted, failed=(broken,) if wrong else (), diagnosis=told if wrong else None,
        closed_form=ClosedFormError(64, 0.013, 0.4, 2.1, 0.006) if wrong else None, seconds=12.3,
        check="landscape check bowl --set solver=fast", slice="landscape slice bowl --dims 0 1",
    )  # fmt: skip


def census() -> Census:
    """Return a census of 64 slices, one of which failed everywhere."""
    space = ParameterSpace.box([f"x{n}" for n in range(6)], 0.0, 1.0)
    design = CensusDesign.draw(space, 64, along="pairs", resolution=6, seed=0)
    draw = np.random.default_rng(0)
    found = [
        SurveyedSlice(
            draw.random((6, 6)) + 0.1 * number, draw.random(len(MEASURES)), draw.random(len(MEASURES)),
            tuple(word for k, word in enumerate(WORDS) if number % (k + 2) == 0), 36,
        )
        for number in range(64)
    ]  # fmt: skip
    found[5].loss[:] = np.nan
    about = {"env": "bowl", "fidelity": "draft", "other": "", "loss_unit": "m", "command": COMMAND.format("census")}
    return conclude(design, found, {}, seed=0, **about, identity=MEASURED, provenance=MEASURED)


def hessian(dim: int, known: int) -> Hessian:
    """Return so many known eigenvalues of all, from large to negative, every third with an error as large as itself."""
    rows = np.arange(known)
    values = np.sign(known * 0.7 - rows) * 10.0 ** (4 - 0.5 * rows)
    errors = np.where(rows % 3 == 2, 2 * np.abs(values), 0.1 * np.abs(values))
    named = {f"the stiffness of spring {part} at the wall": 0.6 for part in range(3)}
    pairs = tuple(
        Eigenpair(row + 1, value, error, error / 2, error / 4, value, False, named)
        for row, value, error in zip(rows.tolist(), values.tolist(), errors.tolist(), strict=True)
    )
    sampled = (3, 8) if known < dim else (0, 0)
    nodes = np.linspace(-5, 900, sampled[0] * sampled[1]).reshape(sampled)
    return Hessian(
        identity=MEASURED, env="triple-move", fidelity="reference", through="best:runs/triple-move", point={},
        moved=0.001, loss=1.0, loss_unit="m", gradient=3.0, dim=dim, source="gradients", why="", whole=known == dim,
        step=2.0**-10, steps=(), pairs=pairs, trace=Estimate(1e4, 9e3, 1.1e4), condition=Estimate(np.nan, 5e3, np.nan),
        negative=Estimate(0.3, 0.2, 0.6), undecided=0.3, asymmetry=0.5, asymmetry_explained=0.01, episodes=300,
        failures=(), provenance=MEASURED | {"command": COMMAND.format("hessian")}, command="", values=values,
        errors=errors, nodes=nodes, weights=np.full(sampled, 1 / max(sampled[1], 1)),
    )  # fmt: skip


CURVE = tuple(
    Usefulness(step, 64, Estimate(sign, sign - 0.1, sign + 0.02), Estimate(cosine, cosine - 0.4, cosine), 0.1, bias)
    for step, sign, cosine, bias in (
        (1e-6, 0.98, 1.0, UNKNOWN),
        (1e-5, 0.98, 1.0, UNKNOWN),
        (1e-3, 0.8, 0.5, Estimate(-0.2, -4.0, 0.3)),
        (1e-2, 0.6, -0.5, Estimate(3.0, -1.0, 7.0)),
        (1e-1, 0.7, 0.2, Estimate(0.25, 0.1, 0.4)),
        (3e-1, 0.7, 0.1, UNKNOWN),
    )
)


def checked(
    curve: tuple[Usefulness, ...] = CURVE,
    *,
    kinds: dict[Kind, int] | None = None,
    wrong: int = 27,
    passed: bool = False,
) -> CheckReport:
    """Return a check that found points of every kind; of the steps 1e-4 is left out, so many changes were noise."""
    region = Region("stiffness of the left spring between 0.52 and 0.95", ("stiffness of the left spring",), 0.0, 64)
    cause = Diagnosis("factor 2", "fail", "certain", "the gradient is half of the slope", "Look.", ("a",), region)
    return CheckReport(
        env="triple-move", fidelity="reference", settings={}, options={}, device="cuda", engine="warp", power=0.05,
        seed=0, passed=passed, findings=(), command=COMMAND.format("check"), diagnoses=() if passed else (cause,) * 2,
        share=Share(wrong, 64, 70, 0.3, 0.55, 0.046), usefulness=curve,
        kinds=dict(zip(Kind, range(1, 20, 2), strict=False)) if kinds is None else kinds,
    )  # fmt: skip
