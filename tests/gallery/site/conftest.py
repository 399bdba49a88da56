"""A small site with everything a page can have, and the browser that looks at it."""

import json
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import pytest
import torch

from gradscape.envs.records import Fidelity
from gradscape.gallery.figures import Figure
from gradscape.gallery.files import DATA, RUN_SUFFIX, RUNS, LeagueFiles
from gradscape.gallery.paper import PaperCaption
from gradscape.gallery.records import save_run
from gradscape.gallery.site.build import build_site
from gradscape.jobs.card import save_slices
from gradscape.jobs.report import PaperWords, Report
from gradscape.landscapes.convert import to_json
from gradscape.landscapes.measures.following import Following, ScaleCosine
from gradscape.landscapes.objective import Evaluation, Objective
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.statistics import Estimate, exactly
from gradscape.landscapes.storage.records import write_record
from gradscape.landscapes.storage.store import SliceStore
from gradscape.optim.league import SceneStandings
from gradscape.optim.race import Race
from gradscape.optim.runs.run import Run
from gradscape.optim.runs.store import RunStore
from gradscape.optim.search import search
from gradscape.studies.convergence import ConvergenceRecord, ConvergenceRule, Remainder
from gradscape.studies.fidelity import FidelityRecord, MeasuredVariant
from gradscape.studies.kept import file_name
from gradscape.studies.samples import Bootstrap, Comparison, GradientError, LossError, Seconds

from ...command import PATIENCE
from ...landscapes.draw.figures.records import card
from ...made_studies import NONE, fidelities, study
from .browsing import DRAWN
from .ledges import build_ledges, keep_ledges

SPACE = ParameterSpace(
    ("speed", "force", "mass"), torch.tensor([-1.0, 0, -10]).double(), torch.tensor([1.0, 20, 10]).double(),
    ("m/s", "N", ""),
)  # fmt: skip
FIGURES = [
    Figure("line", "bounce", (0,), PaperCaption("A line.", 8), resolution=33),
    Figure("bare", "bounce", (0, 1), PaperCaption("Nothing but its slice."), resolution=9),
    Figure("full", "fluid", (0, 1), PaperCaption("All of it <b>&</b> no network.", 10), resolution=12),
]
EPISODES = [
    {"row": 6, "column": 5, "why": "lowest loss", "loss": 1.25, "status": "OK"},
    {"row": 6, "column": 5, "why": "through the slice's point", "loss": 1.25, "status": "OK"},
    {"row": 11, "column": 11, "why": "highest loss", "loss": None, "status": "NONFINITE"},
]
SWEEP = {
    "over": "2", "label": "mass", "low": -10.0, "high": 10.0, "fidelity": "draft", "frames": 12,
    "resolution": [24, 24], "command": "landscape sweep fluid --dims 0 1 --over 2",
}  # fmt: skip


def kept_report() -> Report:
    """Return the report of a shipped slice with other words and other gradients."""
    known = Report.read(DATA / "fluid-8-9")
    verdict, width = known.profile.verdict, known.profile.smoothing[0]
    surface = replace(
        verdict.surface, range=2.0, depth=0.02, minima=exactly(12.0), turns=(exactly(7.5), exactly(3.0)),
        level=exactly(0.0), holder=exactly(0.9), word="rugged", at_least=False, unresolved="",
    )  # fmt: skip
    none, cosine = Estimate(0.0, 0.0, 0.1), Estimate(0.25, 0.1, 0.4)
    scales = (ScaleCosine(0.01, 0.01, 36, 36, cosine, (0.0, 0.2, 0.5), none),)
    verdict = replace(verdict, surface=surface, jumps=None, following=Following(scales, 36, none, none, none, none))
    smoothing = (replace(width, width=0.01, points=36, biased=Estimate(0.25, 0.1, 0.5)),)
    profile = replace(known.profile, verdict=verdict, smoothing=smoothing)
    paper = PaperWords(profile.verdict.compare_words(("rugged", "gradients follow")), "A.2.1")
    return replace(known, profile=profile, paper=paper)


def measured(name: str, changed: str, milliseconds: float, error: float | None) -> MeasuredVariant:
    """Return what a study says of a variant, its error in percent of the spread of 2 J."""
    found = NONE if error is None else Bootstrap(error / 100, error / 200, error / 50)
    compared = Comparison(
        LossError(NONE, NONE if error is None else found, NONE, found), Bootstrap(0.987, None, None),
        GradientError(Bootstrap(0.654, None, None), NONE), 0.25, 64, Seconds(milliseconds / 2e3, milliseconds / 1e3), 8,
    )  # fmt: skip
    return MeasuredVariant(name, changed, Fidelity(name, dt=0.1), "warp", "cuda", {}, 2_500_000, compared)


def studied(device: str) -> FidelityRecord:
    """Return a study of fidelities on a device."""
    rows = (
        measured("reference", "named", 400, 0), measured("draft", "named", 4, 9), measured("coarse", "dt", 2, None),
        measured("standard", "named", 40, 3), measured("slow", "dt", 50, 4),
    )  # fmt: skip
    identity = {"options": {"goal": "high"}, "device": device, "engine": "warp", "model_version": 1}
    found = replace(fidelities(rows, "fluid"), loss_unit="J", identity=identity)
    return replace(found, command="landscape study fidelity fluid")


KNOWN = Bootstrap(0.04, 0.03, 0.05)
CONVERGENCE = ConvergenceRecord(
    env="fluid", reference="reference", points=16, seed=0, loss_unit="J", spread=2.0, settings=(),
    rule=ConvergenceRule(replace(KNOWN, value=0.1), KNOWN, "dt", False, ("dt",)),
    remainders=(Remainder("standard", KNOWN, KNOWN),), divergence=None, distributions=None, refused=(),
    identity={"model_version": 1, "engine": "warp", "device": "cuda", "options": {}}, provenance={},
    command="landscape study convergence fluid",
)  # fmt: skip


CARD = card()


class Bowl(Objective):
    """The squared distance from a point of the scaled box, and a corner that is not finite."""

    space = SPACE

    def __init__(self, name: str) -> None:
        self.name = name

    def evaluate(self, x, *, grad=True):  # type: ignore[no-untyped-def]
        z = 2 * self.space.to_unit(x) - 1
        loss, slope = 1 + (z + 0.1).square().sum(dim=1), 2 * (z + 0.1) * torch.tensor([1, 0.1, 0.1])
        loss[(z[:, :2] > 0.75).all(dim=1)] = torch.nan
        return Evaluation.from_results(loss, slope if grad else None)


def keep(figure: Figure, folder: Path) -> None:
    """Sample a figure's slice."""
    bowl, engine = Bowl(figure.env), {"fluid": "warp"}.get(figure.env, "taichi")
    identity = {"objective": figure.env, "options": {}, "fidelity": "standard", "engine": engine}
    plane = Plane.through(SPACE, SPACE.center, figure.dims, resolution=figure.resolution)
    path = folder / figure.id / "slice.zarr"
    store = SliceStore.create(path, plane, SPACE, identity=identity, provenance={"loss_unit": "J"})
    sample(bowl, plane, store)


def picture(path: Path) -> None:
    """Write a picture."""
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "lavfi", "-i", "testsrc=size=160x120"]
    subprocess.run([*program, "-frames:v", "1", str(path)], check=True)


def film(path: Path) -> None:
    """Write a short film and its last frame."""
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "lavfi", "-i"]
    test = "testsrc=size=160x120:rate=10:duration=1"
    subprocess.run([*program, test, "-pix_fmt", "yuv420p", f"{path}.mp4"], check=True)
    picture(Path(f"{path}.webp"))


def scene_standings(env: str, left_out: dict[str, str]) -> SceneStandings:
    """Return what a race of made-up runs says, of three methods and five seeds that are far apart."""
    space, runs = Bowl(env).space, dict[str, list[Run]]()
    for number, method in enumerate(("bo-leap", "cma-es", "random")):
        for seed in range(5):
            about = {"objective": env, "options": {}, "method": method, "seed": seed, "fidelity": "draft"}
            store = RunStore.in_memory(space, identity={**about, "device": "cpu"}, budget=12)
            data = search(Bowl(env), "random", store, budget=12, gradient_cost=2.0).dataset()
            loss = data["loss"] + number * 10 + seed
            runs.setdefault(method, []).append(Run(data.assign(loss=loss).assign_attrs(method=method, seed=seed)))
    return SceneStandings.of(Race(runs, 12), left_out=left_out, command=f"landscape league {env}")


def league(folder: Path) -> None:
    """Leave a league of two scenes, in one of which a method did not run."""
    (folder / "league").mkdir()
    for env, left_out in (("fluid", {}), ("bounce", {"turbo": "turbo is <not> here"})):
        files = LeagueFiles.of(folder, env)
        write_record(files.record, to_json(scene_standings(env, left_out)))
        picture(files.picture)
        picture(files.dark)
    sliced = LeagueFiles.of(folder, "fluid").slice
    keep(FIGURES[1], folder / "league")
    (folder / "league" / FIGURES[1].id).rename(sliced.record.parent)
    picture(sliced.picture)
    picture(sliced.dark)
    write_record(sliced.record, {"key": {}, "command": "landscape slice fluid --dims 0 1 --through best"})


def census(folder: Path) -> None:
    """Leave what many slices of an environment are like."""
    shares = {
        "rugged": 0.75, "discontinuous": 0.5, "very smooth": 0.0, "gradients do not follow": 0.9,
        "gradients follow": 0.1,
    }  # fmt: skip
    each = {"axes": ["speed [m/s]", "force [N]"], "range": [0.5, 2.5], "failed": 0.0, "measures": [0.4, None]}
    about = {"fidelity": "standard", "other": "", "loss_unit": "J", "along": "pairs", "resolution": 24, "gradients": 1}
    unknown = {"value": None, "low": None, "high": None}
    record = {
        "env": "fluid", **about, "seed": 0, "episodes": 1152, "command": "landscape census fluid",
        "slices": [{"base": k, "cut": 0, **each, "words": ["rugged", "discontinuous"]} for k in range(2)],
        "words": {word: {"value": one, "low": one / 2, "high": (1 + one) / 2} for word, one in shares.items()},
        "spreads": {name: {"quantiles": [None] * 5, "median": unknown} for name in ("turns", "minima")},
        "parts": {}, "exhausted": [False, False], "identity": {}, "provenance": {},
    }  # fmt: skip
    (folder / "census").mkdir()
    write_record(folder / "census/fluid-cuda.json", record)
    picture(folder / "census/fluid-cuda.png")


COMPANIONS = [
    {"through": "center", "lowest": 0.25, "highest": 3.5, "failed": 0.0},
    {"through": "example:scoop", "lowest": None, "highest": None, "failed": 1.0},
]


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Leave what `landscape gallery compute` does: a full figure, a line with searches, a bare one."""
    folder = tmp_path_factory.mktemp("data")
    for figure in FIGURES:
        keep(figure, folder)
    for env in ("bounce", "fluid"):
        for method in ("random", "descents"):
            identity = {"objective": env, "options": {}, "method": method, "seed": 0, "fidelity": "draft"}
            provenance = {"command": f"landscape optimize {env} --method {method}"}
            run = RunStore.open_or_create(
                folder / "runs.tmp" / env / method, SPACE, identity=identity, provenance=provenance, budget=24
            )
            (folder / RUNS / env).mkdir(parents=True, exist_ok=True)
            table = search(Bowl(env), method, run, budget=24, gradient_cost=2.0).dataset()
            save_run(table, folder / RUNS / env / f"{method}-0{RUN_SUFFIX}")
    full = folder / "full"
    (full / "episodes.json").write_text(json.dumps(EPISODES))
    (full / "sweep.json").write_text(json.dumps(SWEEP))
    write_record(full / "report.json", to_json(kept_report()))
    picture(full / "gradient-quality.png")
    (full / "companions.json").write_text(json.dumps({"slices": COMPANIONS}))
    picture(full / "companions.png")
    (folder / "studies").mkdir()
    parts = replace(study({"drag": 1.0, "wall": 0.2}), identity=CONVERGENCE.identity)
    for found in (studied("cuda"), studied("cpu"), parts, CONVERGENCE):
        path = folder / "studies" / file_name("fluid", found.device, found.kind)
        path.write_text(json.dumps(to_json(found)))
        picture(path.with_suffix(".png"))
    (folder / "card").mkdir()
    write_record(folder / "card/card.json", to_json(CARD))
    save_slices(folder / "card/card.npz", CARD.slices)
    picture(folder / "card/card.png")
    league(folder)
    census(folder)
    for name in ("episode-6-5", "episode-11-11", "sweep"):
        film(full / name)
    (full / "episode-11-11.mp4").unlink()
    return folder


@pytest.fixture
def blank() -> None:
    """Leave no picture blank: a browser looks at those of the site, which the first test to ask for it builds."""


@pytest.fixture(scope="session")
def site(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "deep" / "gallery"
    build_site([*FIGURES, Figure("later", "rope", (0, 1), PaperCaption("Not yet."))], data, folder)
    return folder


@pytest.fixture(scope="session")
def ledge_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ledges")
    keep_ledges(folder)
    return folder


@pytest.fixture(scope="session")
def ledges(ledge_data: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("maps") / "site"
    build_ledges(ledge_data, folder)
    return f"file://{folder}/"


@pytest.fixture
def filed(site: Path) -> str:
    return f"file://{site}/"


@pytest.fixture
def visit(browser) -> Iterator[Callable]:  # type: ignore[no-untyped-def, type-arg]
    """Open a page and, at the end, hold that it asked for nothing elsewhere and complained of nothing."""
    contexts = []
    complaints: list[str] = []
    asked: list[str] = []
    roots: list[str] = []

    def go(root: str, path: str, *, width: int = 1100, **options):  # type: ignore[no-untyped-def]
        context = browser.new_context(viewport={"width": width, "height": 900}, **options)
        context.set_default_timeout(PATIENCE)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("requestfailed", lambda request: complaints.append(f"{request.url} failed: {request.failure}"))
        page.on("response", lambda response: complaints.append(response.url) if response.status >= 400 else None)
        page.on("request", lambda request: asked.append(request.url))
        roots.append(root)
        page.goto(root + path, wait_until="load")
        page.evaluate(DRAWN)  # where things are on a canvas is known once it was drawn
        return page

    yield go
    aborted = "net::ERR_ABORTED"  # a film that is not played to its end is not loaded to its end
    assert [said for said in complaints if not said.endswith(aborted)] == []
    assert asked
    assert not [url for url in asked if not url.startswith((*roots, "data:"))]
    for context in contexts:
        context.close()
