"""The checks of several environments, one after the other or in processes of their own, and their results as JUnit."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar
from xml.etree import ElementTree

import cloudpickle

from ..landscapes.checks.finding import KNOWN, SKIP, Finding
from ..landscapes.plain import printable
from ..landscapes.storage.files import make_folder, replacing
from ..optim.processes import prepare_process
from .check import CheckJob, CheckReport
from .scene import SceneSpec
from .watch import PREPARING, Stopped, Watch

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class CheckReports:
    """Record the reports of several environments, in order, and the reasons why others could not be checked."""

    derived: ClassVar = ("passed",)

    reports: tuple[CheckReport, ...]
    failed: dict[str, str]

    @property
    def passed(self) -> bool:
        """Whether all were checked and none fails."""
        return not self.failed and all(report.passed for report in self.reports)

    def table(self) -> pd.DataFrame:
        """Return a table with a row for each environment, indexed by `env`: `passed`, and `said`, the first problem."""
        import pandas as pd

        rows = [(one.env, one.passed, sum_up(one)) for one in self.reports]
        rows += [(name, False, why) for name, why in self.failed.items()]
        return pd.DataFrame(rows, columns=["env", "passed", "said"]).set_index("env")

    def _repr_html_(self) -> str:
        """Show the table in a notebook."""
        return str(self.table().to_html())


def sum_up(report: CheckReport) -> str:
    """Return the first cause of a failure, else the first check that failed, else what was found of the gradient."""
    said = [one.what for one in report.diagnoses if one.outcome == "fail"]
    said += [f"{one.check}: {one.why or one.figure}" for one in report.findings if one.bad]
    said += [one.figure for one in report.findings if one.check == "gradient"]
    return next(iter(said), "no check applies")


@dataclass(frozen=True)
class ChecksJob:
    """Environments to check, each made from its spec; in `processes` at a time where these are more than one."""

    specs: Sequence[SceneSpec]
    power: float
    seed: int
    processes: int = 1
    command: str = ""

    def run(self, watch: Watch | None = None) -> CheckReports:
        """Check all and return what was found; an environment that cannot be checked is left out with the reason.

        Raises Stopped where it is interrupted.
        """
        watch, found, failed = watch or Watch(), dict[int, CheckReport](), dict[int, str]()
        watch.plan(work for spec in self.specs for work in self._open(spec).work())
        try:
            for number, outcome in self._outcomes(watch):
                if isinstance(outcome, CheckReport):
                    found[number] = outcome
                else:
                    failed[number] = outcome
        except KeyboardInterrupt as stop:
            done = len(found) + len(failed)
            raise Stopped(
                f"{done} of {len(self.specs)} environments were checked, but nothing is kept", kept=False
            ) from stop
        names = {number: _name(self.specs[number]) for number in sorted(failed)}
        return CheckReports(
            tuple(found[number] for number in sorted(found)), {name: failed[n] for n, name in names.items()}
        )

    def _open(self, spec: SceneSpec) -> CheckJob:
        return CheckJob.open(spec, power=self.power, seed=self.seed, command=self.command)

    def _outcomes(self, watch: Watch) -> Iterable[tuple[int, CheckReport | str]]:
        """Yield the number of each environment with its report, or why there is none, in the order they are done."""
        if self.processes == 1:
            for number, spec in enumerate(self.specs):
                yield number, _outcome(partial(_check, self, spec, watch))
            return
        count, others = min(self.processes, len(self.specs)), set(multiprocessing.active_children())
        with ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), prepare_process) as pool:
            work = [partial(_check, replace(self, specs=(spec,), processes=1), spec, Watch()) for spec in self.specs]
            waiting = {pool.submit(_work, cloudpickle.dumps(one)): n for n, one in enumerate(work)}
            try:
                with watch.progress(len(waiting), "environments") as advance:
                    advance(0)
                    for done, future in enumerate(as_completed(waiting), start=1):
                        yield waiting[future], _outcome(future.result)
                        advance(done, _name(self.specs[waiting[future]]))
            except BaseException:  # an interrupt, too, which they are deaf to
                for process in set(multiprocessing.active_children()) - others:
                    process.terminate()
                raise


def _check(job: ChecksJob, spec: SceneSpec, watch: Watch) -> CheckReport:
    with watch.busy(f"{_name(spec)}: {PREPARING}"):
        opened = job._open(spec)
    return opened.run(watch)


def _work(sent: bytes) -> CheckReport:
    """Do what another process has sent."""
    found: CheckReport = cloudpickle.loads(sent)()
    return found


def _outcome(check: Callable[[], CheckReport]) -> CheckReport | str:
    """Return a report, or why there is none: others are checked all the same."""
    try:
        return check()
    except Exception as error:
        return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _name(spec: SceneSpec) -> str:
    """Return what an environment was called by whoever asked for it."""
    return spec.name if isinstance(spec.name, str) else str(spec.name.name)


# ---- JUnit's XML, which every service that runs tests reads: a suite for each environment, a case for each finding.


def write_junit(path: Path, found: CheckReports) -> None:
    """Write what was found as JUnit's XML: what is known to fail counts as skipped, and a warning is no failure."""
    suites = ElementTree.Element("testsuites", name="gradscape")
    for report in found.reports:
        causes = "\n".join(f"{one.what}. Try: {one.remedy}" for one in report.diagnoses)
        suite = _suite(suites, report.env, report.findings)
        for finding in report.findings:
            _add_case(suite, report.env, finding, causes)
    for name, why in found.failed.items():
        suite = ElementTree.SubElement(suites, "testsuite", name=name, tests="1", failures="0", errors="1", skipped="0")
        case = ElementTree.SubElement(suite, "testcase", classname=f"gradscape.check.{name}", name="all checks")
        ElementTree.SubElement(case, "error", message=printable(why))
    ElementTree.indent(suites)
    make_folder(path.absolute().parent)
    with replacing(path) as partial_path:
        ElementTree.ElementTree(suites).write(partial_path, encoding="utf-8", xml_declaration=True)


def _suite(suites: ElementTree.Element, name: str, findings: Sequence[Finding]) -> ElementTree.Element:
    bad, left = sum(one.bad for one in findings), sum(one.outcome in (SKIP, KNOWN) for one in findings)
    counts = {"tests": str(len(findings)), "failures": str(bad), "errors": "0", "skipped": str(left)}
    return ElementTree.SubElement(suites, "testsuite", {"name": printable(name), **counts})


def _add_case(suite: ElementTree.Element, name: str, finding: Finding, causes: str) -> None:
    case = ElementTree.SubElement(
        suite, "testcase", classname=printable(f"gradscape.check.{name}"), name=printable(finding.check)
    )
    said = printable(f"{finding.figure} ({finding.why})" if finding.why else finding.figure)
    if finding.bad:
        failure = ElementTree.SubElement(case, "failure", message=said)
        failure.text = "\n".join(map(printable, causes.splitlines()))
    elif finding.outcome in (SKIP, KNOWN):
        ElementTree.SubElement(case, "skipped", message=said)
    else:
        ElementTree.SubElement(case, "system-out").text = f"{finding.outcome}: {said}"
