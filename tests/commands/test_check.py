"""`landscape check`: ours and anyone's, what it prints, how it leaves."""

import sys
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

import pytest

from gradscape.envs.registry import Entry, entries, environment_class
from gradscape.jobs import check as job
from gradscape.jobs.scene import SceneSpec
from gradscape.landscapes.checks import suite as conformance

from ..command import Run

RUGGED = ("ackley", "griewank", "pinball-16")  # over a hundredth of the box
FUNCTIONS = [name for name, entry in entries().items() if set(entry.fidelities) == {"exact"}]

# Another package's environment: its gradient is wrong where asked to be.
BOWL = '''
from dataclasses import dataclass
import torch
from gradscape.envs.base import Environment, Fidelity
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace

@dataclass(frozen=True)
class Options:
    wrong: bool = False
    drifting: bool = False

class Bowl(Environment):
    """A bowl."""
    name = "another-name"
    fidelities = {"only": Fidelity("only", dt=0.1, precision="float64")}
    Options = Options
    calls = 0
    space = ParameterSpace.box(["a", "b"], -1.0, 2.0)

    def _evaluate(self, x, *, grad):
        self.calls += 1
        if self.options.drifting and self.calls % 2:
            x = x + torch.nan
        return Evaluation.from_results(x.square().sum(dim=1), (-x if self.options.wrong else 2 * x) if grad else None)
'''


@pytest.fixture
def bowl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "bowl_package.py").write_text(BOWL)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(entries(), "bowl", Entry("bowl", "bowl_package:Bowl"))
    yield
    sys.modules.pop("bowl_package")


def test_bounce_passes_at_draft(run: Run, tmp_path: Path) -> None:
    done = run.ok("check bounce --device cpu --json")
    report = done.json
    assert (report["env"], report["fidelity"], report["passed"]) == ("bounce", "draft", True)
    checks = {found["check"]: found for found in report["checks"]}
    said = {name: found["outcome"] for name, found in checks.items() if found["outcome"] != "pass"}
    assert said == {"forward against reverse": "skip", "usefulness": "warn", "shorter time steps": "warn"}
    assert 0 < checks["energy drift"]["numbers"]["rise"] < 0.1
    ladder = {row["step"]: row for row in checks["gradient"]["table"]}
    assert ladder[1e-6]["error"] < 1e-6  # a true gradient,
    assert ladder[0.1]["sign"] < 0.9  # of a landscape that misleads
    assert (report["share"]["wrong"], report["share"]["points"]) == (0, 64)
    assert report["share"]["missed"] < 0.05
    (found,) = report["diagnoses"]  # its impacts begin at steps of time
    assert (found["cause"], found["outcome"]) == ("discretisation", "warn")
    assert checks["corners"]["numbers"]["finite"] == 8
    for name in ("dt 8x", "horizon 8x", "ke 100000", "10% outside the box"):
        assert sum(checks[name]["numbers"][kind] for kind in ("finite", "non-finite", "escaped", "error")) >= 2
    assert "bounce · draft · cpu · warp · 59 points: about 1576 episodes and" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", [*FUNCTIONS, "pinball-2", "pinball-16"])
def test_quick_environments_pass_at_draft(name: str, run: Run) -> None:
    done = run("check", name, "--power", "20%", "--device", "cpu", "--json")
    said = {found["check"]: found["outcome"] for found in done.json["checks"]}
    step = said.pop("usefulness")
    assert set(said.values()) <= {"pass", "skip"}
    assert step == ("warn" if name in RUGGED else "pass")
    assert done.returncode == 0


@pytest.mark.parametrize("name", ["flip", "fluid"])
def test_slow_environments_keep_their_promises_at_draft(name: str) -> None:
    """For a quarter of an episode: what they promise does not depend on its length."""
    scene = SceneSpec(name, device="cpu", options={"horizon": 0.25})
    whole = job.CheckJob.open(scene, power=0.5).findings()
    findings = takewhile(lambda found: found.check != "order of calls", whole)
    assert {found.check: found.outcome for found in findings} == dict.fromkeys(
        ["shapes", *conformance.PROMISES], "pass"
    )


def test_a_time_step_is_checked_once_however_it_is_called(run: Run) -> None:
    done = run("check cartpole --power 50% --device cpu")
    nearest = "the nearest step that fits into a control step is the same as for dt 1x"
    text = " ".join(done.stdout.split())
    assert text.count(nearest) == 3
    assert "pass dt 1x" in text
    assert done.returncode == 0


@pytest.mark.nightly
@pytest.mark.parametrize("name", sorted(name for name, entry in entries().items() if not entry.extra))
def test_the_whole_check_of_every_environment_passes(run: Run, name: str) -> None:
    """Seconds each, of soft bodies four to fifteen minutes; engines of others are not ours to vouch for."""
    run.ok("check", name, "--device", "cpu")


def test_anyone_s_environment_is_checked_and_each_check_has_a_line(run: Run, bowl: None) -> None:
    done = run.ok("check bowl --power 30% --seed 5")
    text = " ".join(done.stdout.split())
    for shown in (
        "pass      shapes                    loss (8,), grad (8, 2), status (8,)",
        "pass      dt 8x                     2 finite",
        "horizon 1x to 8x (no setting controls how long an episode is)",
        "relative error, median",
        "passes: ",
    ):
        assert " ".join(shown.split()) in text
    assert "fail" not in done.stdout.replace("failed", "")


def test_a_failure_is_exit_code_1_and_names_itself(run: Run, bowl: None) -> None:
    done = run("check bowl --set wrong=true")
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert lines[0] == "fail      scaled (certain): the gradient is -0.5 times the slope"
    assert lines[1].startswith("          Try: ")
    failed = [line[10:35].strip() for line in lines if line.startswith("fail ")][1:]
    assert failed == ["gradient", "special places", "parameters"]
    assert done.stdout.splitlines()[-1].startswith("fails: ")
    report = run("check bowl --set wrong=true --json").json
    assert not report["passed"]
    assert report["options"] == {"wrong": True, "drifting": False}


def test_json_knows_no_infinity(run: Run, bowl: None) -> None:
    done = run("check bowl --set drifting=true --json")
    assert done.returncode == 1
    assert "Infinity" not in done.stdout
    found = {found["check"]: found for found in done.json["checks"]}["determinism"]
    assert (found["outcome"], found["numbers"]["loss"]) == ("fail", None)


def test_a_known_exception_is_printed_with_its_reason_until_it_is_none(
    run: Run, monkeypatch: pytest.MonkeyPatch, bowl: None
) -> None:
    reasons = dict.fromkeys(("gradient", "special places", "parameters"), "its gradient points downhill")
    monkeypatch.setattr(environment_class("bowl"), "known_failures", {"only": reasons})
    excused = run.ok("check bowl --set wrong=true")
    assert excused.stdout.count("known: its gradient points downhill") == 3
    no_longer = run("check bowl")
    assert no_longer.returncode == 1
    assert "it passes, so this reason no longer applies: its gradient points downhill" in no_longer.stdout


def test_known_failures_are_of_fidelities_there_are() -> None:
    for name in entries():
        kind = environment_class(name)
        assert set(kind.known_failures) <= set(kind.fidelities), name


def test_an_interrupt_says_that_nothing_is_kept(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(conformance.PROMISES, "determinism", interrupted)
    done = run("check branin")
    assert done.returncode == 130
    assert "stopped: 4 checks were done, but nothing is kept; the same command starts again" in done.stderr
    assert "Traceback" not in done.stderr
