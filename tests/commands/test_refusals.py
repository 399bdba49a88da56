"""What the verbs refuse: in one line, with exit code 2, leaving everything as it was."""

import shutil
from pathlib import Path

import pytest

from gradscape.api.view import DISPLAYS

from ..command import Run, make

SLICE = "slice branin --dims 0 1"
SEARCH = "optimize branin --method"
REFINED = f"{SLICE} --resolution 33"
SWEEP = "sweep ackley --set dim=3"
TOLERANT = "slice bounce --dims 0 1 --tolerance"
NOT_TAICHI = "bounce has engine warp; got engine 'taichi'"
WORDS = {  # in an empty folder
    "slice flud --dims 0 1": "did you mean fluid?",
    "slice bounce": "--dims",
    "slice branin --dims 0 2": "numbered 0 to 1; got 2",
    "slice branin --dims 0 0": "two different parameters; got 0, 0",
    f"{SLICE} --resolution 1": "--resolution",
    f"{SLICE} --fidelity best": "has fidelities exact; got 'best'",
    f"{SLICE} --device tpu": "got device 'tpu'",
    f"{SLICE} --through nowhere": "center, random:SEED, example:NAME, best, best:RUN, a file",
    f"{SLICE} --through example:x": "branin has no example 'x'",
    f"{SLICE} --window wide": "got 'wide'",
    f"{SLICE} --window -15:wide": "got '-15:wide'",
    f"{SLICE} --resolution 8.5": "--resolution: not a whole number: 8.5",
    f"{SLICE} extra": "unexpected words: extra",
    f"{SLICE} --set dim=3": "branin has no option 'dim'",
    "slice ackley --dims 0 1 --set dim=two": "dim takes a whole number above 0, at most 100000; got 'two'",
    "slice ackley --dims 0 1 --set dim": "--set takes name=value; got 'dim'",
    "slice bounce --dims 0 1 --engine taichi": NOT_TAICHI,
    f"{REFINED} --refine much": "--refine takes a share such as 1% or 0.01; got 'much'",
    f"{REFINED} --refine 0": "a share of the range between 0 and 1; got 0",
    f"{REFINED} --refine nan": "a share of the range between 0 and 1; got nan",
    f"{REFINED} --refine 120%": "a share of the range between 0 and 1; got 1.2",
    f"{REFINED} --budget 9": "begins with 81 points; got a budget of 9",
    f"{TOLERANT} 5% --set horizon=0.5": "`landscape study fidelity bounce --set=horizon=0.5` measures them",
    f"{TOLERANT} 5% --fidelity draft": "leave out one",
    f"{TOLERANT} close": "such as 5%",
    "optimize bounce --method random --tolerance -1": "such as 5%",
    "bounce --axis w": "axis x, y or z; got 'w'",
    f"{SWEEP} --dims 0 1 --over 1": "moves a third parameter, horizon or smoothing; got --over 1, which the slice",
    f"{SWEEP} --dims 0 1 --over x0": "got --over x0, which the slice itself varies",
    f"{SWEEP} --dims 0 1 --over 9": "numbered 0 to 2; got 9",
    f"{SWEEP} --dims 0 1 --over speed": "no parameter is called 'speed'",
    f"{SWEEP} --dims 0 0 --over 2": "two different parameters; got 0, 0",
    f"{SWEEP} --dims 0 1 --over 2 --frames 1": "--frames",
    "sweep bounce --dims 0 --over 2": "sweep takes two dims",
    "sweep bounce --dims 0 1": "sweep takes --over",
    "sweep bounce --dims 0 1 --over 2 --along random:1": "give one of them",
    "sweep bounce --over 2 --along center:random:1 --device cpu": "two dims and at least two frames",
    "replay ackley": "ackley has no episode to draw",
    "bench bonce": "did you mean bounce?",
    "bench bounce --engine taichi": NOT_TAICHI,
    "bench bounce --second-engine taichi": NOT_TAICHI,
    "bench fluid --second-engine warp": "bench compares two different engines; got warp twice",
    "bench bounce --batch 0": "--batch",
    "bench bounce --set wind=1": "bounce has no option 'wind'",
    "check bonce": "did you mean bounce?",
    "check bounce --points 1": "--points",
    "check bounce --power 0": "power",
    "check bounce --figure-width-mm 85": "give --out, too",
    "check branin bounce --out checked": "--out takes the results of one environment; got 2 environments",
    "check bounce --fidelity best": "bounce has fidelities draft, standard, reference; got 'best'",
    "check bounce --set wind=1": "bounce has no option 'wind'",
    "envs nothing": "no environment is called 'nothing'",
    "export . --to excel": "--to",
    "export .": ". is neither a slice nor a run",
    "pairs rastrigin --set dim=1": "pairs takes an environment with at least two parameters",
    "plan branin": "landscape plan slice branin",
    "plan slice brannin": "did you mean branin?",
    "plan slice branin --resolution 1": "--resolution",
    "plan envs": "envs simulates nothing",
    "plot": "plot",
    "report": "a slice's folder, an environment, or --all",
    "report branin --all": "a slice's folder, an environment, or --all",
    "report brannin": "did you mean branin?",
    "report --all --data nowhere": "contains no figures yet",
    "report branin --points-per-axis 1": "--points-per-axis",
    "study fidelity branin": "branin has one fidelity, exact, so there is nothing to compare",
    "study fidelity bounce --settings speed": "--settings takes dt, resolution",
    "study fidelity bounce --fidelity draft": "got draft, so leave it out",
    "study ladder bounce": "Choose from",
    "study model branin": "branin names no parts of its model",
    "study extremes bounce --time-limit 3": "got time_limit",
    "study fidelity bounce --time-limit 3": "study fidelity takes points, seed, settings; got time_limit",
    "study convergence branin": "there is nothing to compare",
    "study convergence bounce --settings speed": "--settings takes dt, resolution, particles, joint, precision",
    "study convergence bounce --settings resolution": "bounce has none of resolution to refine",
    "study convergence bounce --fidelity draft": "leave it out",
    "optimize brannin --method random": "did you mean branin?",
    f"{SEARCH} cma": "no method is called 'cma'; did you mean cma-es?",
    f"{SEARCH} random --budget 0": "--budget",
    f"{SEARCH} random --seed -1": "--seed",
    f"{SEARCH} random --option sigma=1": "random has no option 'sigma'",
    f"{SEARCH} cma-es --option sigma=big": "sigma takes a number; got 'big'",
    f"{SEARCH} cma-es --option sigma": "--option takes name=value; got 'sigma'",
    f"{SEARCH} cma-es --option sigma=0": "from 1e-09 to 1000; got 0.0",
    f"{SEARCH} random --fidelity best": "has fidelities exact; got 'best'",
    f"{SEARCH} random --set dim=3": "branin has no option 'dim'",
    "methods newton": "no method is called 'newton'",
    "race nothing": "no environment is called 'nothing'",
    "race branin --methods random,magic": "no method is called 'magic'",
    "race branin --methods random --option cma-es.sigma=1": "METHOD.NAME=VALUE for one of random",
    "race branin --methods cma-es --option cma-es.speed=1": "cma-es has no option 'speed'",
    "race branin --seeds 0": "--seeds",
    "race branin --workers 2 --scheduler local:2": "--scheduler brings its own workers",
    "league nothing": "no environment is called 'nothing'",
    "league branin@best": "branin has fidelities exact",
    "league branin --seeds 0": "--seeds",
    "league branin --workers 2 --scheduler local:2": "--scheduler brings its own workers",
}


def refuse_in_a_line(run: Run, command: str, said: str) -> None:
    done = run.refuse(command, said=said)
    assert done.stdout == ""
    assert done.stderr.startswith("landscape: ")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("command", WORDS)
def test_words_that_cannot_be_are_refused_and_nothing_is_left(run: Run, tmp_path: Path, command: str) -> None:
    refuse_in_a_line(run, command, WORDS[command])
    assert not list(tmp_path.iterdir())


RESULTS = {  # in a folder that holds the results of `made`
    "compare cut fine --fidelity draft": "fine is a slice, so leave them out",
    "compare cut fine --set drag=1": "fine is a slice, so leave them out",
    "compare cut cartpole": "A has velocity x where B has t0 cart velocity",
    "compare cut nothing": "no environment is called 'nothing'",
    "compare bounce cut": "there is no slice at bounce; give the folder of one",
    "compare cut across": "A is along velocity x, velocity y and B is along velocity x, velocity z",
    "compare across cut": "give the name of an environment as B",
    "overlay other race": "objective is 'ackley' for the slice and 'bounce' for the run",
    "overlay other small": "options is {'dim': 3} for the slice and {'dim': 2} for the run",
    "overlay cut cut": "is not a run",
    "overlay cut nowhere": "there is no run at",
    "overlay race race": "is not a slice store",
    "overlay cut race --plane tsne": "--plane",
    "overlay cut race --resolution 4": "give --through or --plane, too",
    "overlay cut race --through nowhere": "got 'nowhere', which is none of these",
    "overlay cut race --through small": "small searched 2 parameters; the slice has 3",
    "overlay cut race --through best:small": "the runs have to be of bounce only; small contains runs of",
    "overlay cut race --through best --out over --spawn": "this machine has no display to open over/overlay.rrd on; "
    "leave out --spawn, or use --serve",
    "replay cartpole --params best:small --no-film --device cpu": "the runs have to be of cartpole only",
    "report bare": "report takes a slice with gradients",
    "surface cut small": "of different landscapes: objective is 'bounce'",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make slices of one scene at two fidelities and along another plane, one of another scene, runs of both."""
    cut = "slice bounce --dims 0 1 --resolution 3 --device cpu"
    return make(
        tmp_path_factory.mktemp("made"),
        f"{cut} --out cut",
        f"{cut} --fidelity standard --out fine",
        f"{cut.replace('0 1', '0 2')} --out across",
        "slice branin --resolution 3 --no-gradients --out bare",
        "slice ackley --dims 0 1 --resolution 3 --set dim=3 --out other",
        "optimize bounce --method random --budget 4 --out race/random-0 --device cpu",
        "optimize ackley --method random --budget 4 --out small",
    )


@pytest.fixture
def desk(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the results and somebody's own files, on a machine without a display."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    (tmp_path / "mine").mkdir()
    for name in ("landscape.png", "thesis.tex"):
        (tmp_path / "mine" / name).write_text("precious")
    for name in DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def held(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


@pytest.mark.parametrize("command", RESULTS)
def test_results_that_do_not_belong_together_are_refused(run: Run, desk: Path, command: str) -> None:
    before = held(desk)
    refuse_in_a_line(run, command, RESULTS[command])
    assert held(desk) == before
