"""What a check announces; several environments are checked by processes that end with whoever started them."""

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

import pytest
from torch import Tensor

from gradscape.envs.base import Environment, Fidelity
from gradscape.jobs.check import CheckJob
from gradscape.jobs.checks import ChecksJob
from gradscape.jobs.scene import SceneSpec
from gradscape.jobs.watch import Advance, Stopped, Watch
from gradscape.landscapes import cost
from gradscape.landscapes.objective import Evaluation
from gradscape.landscapes.space import ParameterSpace

from ..clock import Clock


class Interrupted(Watch):
    """Ctrl-C once the first environment is done."""

    @contextmanager
    def progress(self, total: int, what: str = "episodes") -> Iterator[Advance]:
        def advance(done: int, said: str = "") -> None:
            if done:
                raise KeyboardInterrupt

        yield advance


@pytest.mark.e2e
def test_an_interrupt_ends_the_processes_and_says_that_nothing_is_kept() -> None:
    specs = [SceneSpec(name) for name in ("branin", "ackley", "rope", "fluid", "writer")]
    with pytest.raises(Stopped, match=r"^1 of 5 environments were checked, but nothing is kept$") as stopped:
        ChecksJob(specs, 0.2, 0, 2).run(Interrupted())
    assert not stopped.value.kept
    assert multiprocessing.active_children() == []


class Compiled(Environment):
    """A bowl, each of which takes ten seconds to be compiled, and none to be evaluated."""

    own_programs = True
    fidelities: ClassVar[dict[str, Fidelity]] = {"only": Fidelity("only", dt=0.1)}
    space = ParameterSpace.box(["a", "b"], 0.0, 1.0)
    clock: ClassVar[Clock]

    def _setup(self) -> None:
        self.compiled = False

    def _evaluate(self, x: Tensor, *, grad: bool) -> Evaluation:
        self.clock.sleep(0.0 if self.compiled else 10.0)
        self.compiled = True
        return Evaluation.from_results(x.square().sum(dim=1), 2 * x if grad else None)


def test_what_a_check_announces_includes_what_its_variants_compile(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, announced = Clock(), list[tuple[float, float]]()
    Compiled.clock = clock
    monkeypatch.setattr(cost, "time", clock)
    monkeypatch.setattr(cost, "MOMENT", 0.0)
    watch = Watch()
    monkeypatch.setattr(watch, "announce", lambda said, seconds: announced.append((clock.now, seconds)))
    list(CheckJob.open(SceneSpec(Compiled, device="cpu")).findings(watch))
    ((at, seconds),) = announced
    assert clock.now - at > 40.0
    assert seconds == pytest.approx(clock.now - at, rel=0.5)
