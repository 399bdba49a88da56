"""On a GPU the same kernels give the same losses and gradients; skipped where there is none."""

import gc
from dataclasses import replace
from functools import partial

import pytest
import torch

from gradscape.envs.base import Environment
from gradscape.envs.engines import runtime
from gradscape.envs.engines.mpm import solver
from gradscape.envs.engines.runtime import cuda_available
from gradscape.envs.registry import entries, environment_class, make
from gradscape.landscapes.sampling.memory import free_memory

from .scenes import SMALL_STEPS

# A small difference grows from contact to contact: by as much as gradients are steep.
ROUGH = dict.fromkeys(("pinball-16", "swing-velocity", "swing-stiffness", "flip"), 100)
UNEVEN = {("pinball-16", "float32"): 10}  # losses of a ball that has met many pins differ by what it has grown to
SCENES = [name for name in entries() if "cuda" in environment_class(name).devices]

pytestmark = pytest.mark.skipif(not cuda_available(), reason="no CUDA device")


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(("precision", "loss", "grad"), [("float64", 1e-12, 1e-10), ("float32", 1e-4, 1e-3)])
def test_cuda_agrees_with_the_cpu(
    name: str, precision: str, loss: float, grad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In float32 a CPU launches what a GPU does: its own kernels of plasticine round otherwise, by up to 2e-3."""
    if precision == "float32":
        monkeypatch.setattr(solver, "Solver", partial(solver.Solver, columns=True))
    fidelity = replace(environment_class(name).fidelities["draft"], precision=precision)
    one, other = (make(name, fidelity=fidelity, device=device) for device in ("cpu", "cuda"))
    x = one.space.uniform(5, seed=1)
    cpu, cuda = one.evaluate(x), other.evaluate(x)
    assert cpu.grad is not None
    assert cuda.grad is not None
    assert torch.equal(cpu.status, cuda.status)
    loss *= UNEVEN.get((name, precision), 1)
    assert float((cpu.loss - cuda.loss).abs().max()) <= loss * float(cpu.loss.abs().max())
    assert float((cpu.grad - cuda.grad).norm()) <= ROUGH.get(name, 1) * grad * float(cpu.grad.norm())


@pytest.mark.parametrize("name", SCENES)
def test_gradients_on_cuda_are_slopes(name: str) -> None:
    fidelity = replace(environment_class(name).fidelities["draft"], precision="float64")
    env = make(name, fidelity=fidelity, device="cuda")
    x = env.space.uniform(1, seed=2).requires_grad_()
    assert torch.autograd.gradcheck(env, (x,), eps=SMALL_STEPS.get(name, 1e-7), nondet_tol=1e-7, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("kept", [False, True])
def test_a_scene_that_is_dropped_or_released_gives_its_memory_back(name: str, kept: bool) -> None:
    """Without garbage being collected: a solver takes most of what is free for its tape, and the next one needs it."""

    def use() -> Environment:
        env = make(name, fidelity="draft", device="cuda")
        x = env.space.uniform(2, seed=4)
        for _ in range(3):  # the first run finds what is free, the second fills it, the third repeats its launches
            env.evaluate(x)
        return env

    use()  # compiles, and loads modules
    free_memory()
    before = runtime.free_memory()
    gc.disable()
    try:
        env = use()
        taken = before - runtime.free_memory()
        if kept:
            env.release()
        else:
            del env
        torch.cuda.empty_cache()
        assert before - runtime.free_memory() < max(0.05 * taken, 64e6)
    finally:
        gc.enable()


@pytest.mark.parametrize(("name", "known"), [("fluid", "scoop"), ("assembly", "demonstration")])  # odd substeps
def test_launches_repeated_as_graphs_do_what_they_did_at_first(name: str, known: str) -> None:
    """One row is few enough for graphs: recorded when it comes again, launched whole from then on."""
    fidelity = replace(environment_class(name).fidelities["draft"], precision="float64")
    env = make(name, fidelity=fidelity, device="cuda")
    one, other = env.example(known)[None], env.space.uniform(1, seed=3)
    first = env.evaluate(one)
    for x in (other, one, other, one):
        env.evaluate(x)
    again = env.evaluate(one)
    assert env._solvers is not None
    with env._solvers.lend() as lent:
        assert {"forward", "backward"} <= {key[0][0] for key in lent.solver.launches.graphs}
    assert first.grad is not None
    assert again.grad is not None
    torch.testing.assert_close(again.loss, first.loss, rtol=1e-12, atol=0)
    assert float((again.grad - first.grad).norm()) <= 1e-9 * float(first.grad.norm())


@pytest.mark.parametrize("name", SCENES)
def test_every_time_and_in_every_batch_episodes_are_the_same_to_the_last_bit(name: str) -> None:
    env = make(name, fidelity="draft", device="cuda")
    x = env.space.uniform(64, seed=4)
    whole = env.evaluate(x)
    assert whole.grad is not None
    for rows in (slice(0, 64), slice(0, 7), slice(7, 14), slice(57, 64), slice(0, 1), slice(63, 64)):
        some = env.evaluate(x[rows])
        assert some.grad is not None
        assert torch.equal(some.loss, whole.loss[rows])
        assert torch.equal(some.grad, whole.grad[rows])
