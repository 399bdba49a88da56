"""`gs.testing.assert_gradients`: a check of gradients in one line of your own tests."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Unpack

from ..jobs.watch import Watch
from .call import Call, calling
from .measure import check
from .options import Scene, SceneKeywords, Seed, Share

if TYPE_CHECKING:
    from ..jobs.check import CheckReport
    from ..landscapes.checks.diagnosis import Diagnosis


def assert_gradients(
    scene: Scene, *, power: Share = 0.05, seed: Seed = 0, **keywords: Unpack[SceneKeywords]
) -> CheckReport:
    """Assert that the gradients of an environment are right, and return the report of `gs.check`; it prints nothing.

    `scene`, `power` and the other keywords are those of `gs.check`. A defect that fills a share `power` of the box is
    found with a probability of 95 %. A warning is not a failure.

        def test_gradients_of_my_simulator():
            gs.testing.assert_gradients(gs.from_torch(simulate, space))

    Raises AssertionError with a line for each cause: what is wrong, where, and what to try. Raises ValueError if
    `scene` is not a simulator, or if it does not support a keyword.
    """
    name = scene if isinstance(scene, str) else getattr(scene, "name", type(scene).__name__)
    with calling(Call(f"gradscape.testing.assert_gradients({name})", Watch())):
        report = check(scene, power=power, seed=seed, **keywords)
    if not report.passed:
        raise AssertionError("\n".join(_lines(report)))
    return report


def _lines(report: CheckReport) -> Iterator[str]:
    """Yield what is wrong in one line, and then each cause, and each check that failed, in a line of its own."""
    share = report.share
    where = f": gradients are wrong at {share.describe()}" if share is not None and share.wrong else ""
    yield f"{report.env} fails its check{where}"
    causes = [one for one in report.diagnoses if one.outcome == "fail"]
    yield from (f"- {_describe(one)}" for one in causes)
    for finding in report.findings:
        if finding.bad:
            said = not finding.why or any(one.what in finding.why for one in causes)
            yield f"- {finding.check}: {finding.figure}" + ("" if said else f" ({finding.why})")


def _describe(diagnosis: Diagnosis) -> str:
    """Return a cause in one line: what is wrong, how sure that is, where, and what to try."""
    what, region = diagnosis.what.rstrip("."), diagnosis.region
    names = [name for name in diagnosis.parameters if name not in what]
    by = f" by {', '.join(names)}" if names else ""
    where = f", where {region.rule}" if region is not None and region.rule not in what else ""
    return f"{what}{by}{where} ({diagnosis.certainty}). Try: {diagnosis.remedy}"
