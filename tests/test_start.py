"""The start of a command: which packages it imports, walked over all that the project depends on."""

from __future__ import annotations

import gc
import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path
from pkgutil import iter_modules

import pytest
import scipy

from gradscape import __main__ as command
from gradscape.cli import verbs

from .command import modules

pytestmark = pytest.mark.e2e

PROJECT = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
TOLD = {"cyclopts", "rich"}  # a command's words, and its tables
SLICED = TOLD | {"numpy", "torch", "jaxtyping", "xarray", "pandas", "pyarrow", "zarr", "scipy", "matplotlib", "cattrs"}
BROUGHT = {"torchgen", "mpl_toolkits", "cloudpickle", "attr", "attrs"}  # by torch, matplotlib, pyarrow and cattrs
BOWL = """
from gradscape import Environment, Fidelity, ParameterSpace


class Bowl(Environment):
    name = "bowl"
    devices = ("cpu",)
    fidelities = {"exact": Fidelity("exact", 0.0, "float64")}
    space = ParameterSpace.box(["a", "b"], -1.0, 1.0)

    def _evaluate(self, x, *, grad):
        from gradscape import Evaluation

        return Evaluation.from_results(x.square().sum(dim=1), 2 * x if grad else None)
"""


def depended() -> set[str]:
    """Return the names under which all that the project depends on is imported, extras and all."""
    asked = [*PROJECT["dependencies"], *(one for extra in PROJECT["optional-dependencies"].values() for one in extra)]
    wanted = {re.split(r"[<>=;\[ ]", one)[0].lower().replace("_", "-") for one in asked} - {"gradscape"}
    return {
        name
        for name, owners in packages_distributions().items()
        if not name.startswith("_") and {owner.lower().replace("_", "-") for owner in owners} & wanted
    }


def packages(loaded: set[str]) -> set[str]:
    """Return what of that is loaded."""
    return {name.partition(".")[0] for name in loaded} & depended()


REFUSED = (
    *(
        "slice nosuch --dims 0 1",
        "check missing.py:Bowl",
        "advise nosuch",
        "advise branin --budget 100",
        "replay nosuch",
        "study fidelity nosuch",
    ),
    *("slice branin --dims 7 8", "slice fluid --dims 0 --along gradient", "slice fluid --along nowhere"),
    *("slice fluid --dims 0 --resolution x", "slice fluid --dims 0 --window x", "slice fluid --dims 0 --refine x"),
    *("slice fluid --dims 0 --tolerance x", "slice fluid --dims 0 --tolerance 5% --fidelity draft"),
    *("slice bounce --dims 0 --set nosuch", "slice bounce --dims 0 --fidelity nosuch"),
    *("slice bounce --dims 0 --device nosuch", "slice bounce --dims 0 --engine nosuch", "bounce --axis w"),
    *(
        "sweep fluid --dims 0 1 --over 12",
        "plan slice fluid --dims 12 0",
        "plan nosuch",
        "plan race fluid --methods nosuch",
    ),
    *("race fluid --methods nosuch", "race fluid --methods random --option bo.a=1", "optimize bounce --method nosuch"),
    *("league nosuch", "league fluid@nosuch", "league fluid --methods nosuch", "methods nosuch", "envs nosuch"),
    *("report nosuch", "report fluid --fidelity nosuch", "bench fluid --second-engine nosuch", "study no fluid"),
    *("compare nosuch fluid", "overlay nosuch run", "surface nosuch", "export nosuch", "view nosuch", "nosuch"),
)


def test_what_is_wrong_with_a_commands_words_is_said_before_anything_that_computes_is_imported(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(BOWL)
    code = (
        "import sys\nfrom gradscape.cli import main\n"
        f"for text in {REFUSED}:\n    try: main(text.split())\n"
        "    except SystemExit as left:\n"
        "        heavy = {'torch', 'numpy', 'warp', 'matplotlib'} & set(sys.modules)\n"
        "        print(text, left.code, *heavy, sep='|')"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert said.stdout.splitlines() == [f"{text}|2" for text in REFUSED]


@pytest.fixture(scope="module")
def sliced(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Return what a slice of somebody's function imports, its picture drawn, where Dask is not installed.

    Where it is, xarray imports it, and half of scipy with it.
    """
    folder = tmp_path_factory.mktemp("sliced")
    (folder / "bowl.py").write_text(BOWL)
    words = ["slice", f"{folder}/bowl.py:Bowl", "--dims", "0", "1", "--resolution", "12", "--out", f"{folder}/cut"]
    loaded = modules(words, missing=("dask",))
    assert (folder / "cut/landscape.png").exists()
    return loaded


def test_what_the_project_depends_on_is_found_by_the_names_it_is_imported_by() -> None:
    assert depended() >= SLICED | {"warp", "skimage", "botorch", "stable_baselines3", "distributed"}


def test_no_help_and_no_list_imports_more_than_what_reads_the_command() -> None:
    each = [[*name.split(), "--help"] for name in verbs()]
    assert len(each) > 20
    assert packages(modules(["--help"], *each, ["envs"], ["methods"])) == TOLD


def test_a_slice_of_a_function_imports_no_engine_and_nothing_that_measures_or_searches(sliced: set[str]) -> None:
    assert packages(sliced) - BROUGHT == SLICED
    scipys = {f"scipy.{one.name}" for one in iter_modules(scipy.__path__) if not one.name.startswith("_")}
    assert len(scipys) > 15
    assert sliced & scipys == {"scipy.special", "scipy.version"}  # what has the quantiles
    code = "import sys, torch; print(*sys.modules)"
    alone = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {name for name in sliced if name.startswith("torch.")} <= set(alone)  # what torch imports itself


def test_what_a_command_imports_is_not_looked_through_for_garbage(monkeypatch: pytest.MonkeyPatch) -> None:
    before, seen = gc.get_threshold(), list[int]()

    def run() -> None:
        seen.append(gc.get_threshold()[0])
        gc.collect(0)  # as where a command has made more than it imports
        seen.append(gc.get_threshold()[0])

    monkeypatch.setattr("gradscape.cli.main", run)
    try:
        command.main()
        assert gc.get_freeze_count() > 0
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()
    assert seen == [command.IMPORTED, command.YOUNG]


def test_a_slice_imports_fewer_objects_than_are_made_before_garbage_is_looked_for() -> None:
    code = "import gc; gc.disable(); import gradscape.jobs.slice, gradscape.envs.pinball; print(gc.get_count()[0])"
    made = int(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    assert command.YOUNG < made < command.IMPORTED
