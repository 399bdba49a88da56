"""Weights and trainings: a linear-quadratic problem in closed form, filters, checkpoints, the plane they move in."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.landscapes.directions import filter_directions
from gradscape.landscapes.objective import Status
from gradscape.landscapes.training import Training, TrainingPath, read_checkpoint

from ..linear_quadratic import START, STEPS, A, B, Q, R, closed_form

GAINS = gs.ParameterSpace.of_weights({"K": (1, 2)}, 6.0)
NET = gs.ParameterSpace.of_weights({"0.weight": (3, 4), "0.bias": (3,), "1.weight": (2, 3), "1.bias": (2,)}, 5.0)


def rolled(K: torch.Tensor) -> torch.Tensor:
    """The loss of gains, shape (batch, 2), step by step in torch."""
    a, b, q, r, start = (torch.from_numpy(one) for one in (A, B, Q, R, START))
    x, loss = start.expand(len(K), 2), torch.zeros(len(K)).double()
    for _ in range(STEPS):
        u = -(K * x).sum(dim=1, keepdim=True)
        loss = loss + (x @ q * x).sum(dim=1) + (u @ r * u).sum(dim=1)
        x = x @ a.T + u @ b.T
    return loss + (x @ q * x).sum(dim=1)


def scanned(K: Any) -> Any:
    """The loss of one gain in JAX."""

    def step(x: Any, _: Any) -> Any:
        u = -K.reshape(1, 2) @ x
        return A @ x + B @ u, x @ Q @ x + u @ R @ u

    x, losses = jax.lax.scan(step, jnp.asarray(START), length=STEPS)
    return losses.sum() + x @ Q @ x


LQR = gs.from_torch(rolled, GAINS, name="lqr")


def descend(folder: Path, rate: float = 0.02, count: int = 12) -> np.ndarray[Any, Any]:
    """Leave the checkpoints of a gradient descent by the closed form, and return them."""
    K, found = np.array([[0.3, 0.9]]), []
    for step in range(count):
        torch.save({"K": torch.from_numpy(K)}, folder / f"step{step}.pt")
        found.append(K.ravel())
        K = K - rate * closed_form(K)[1]
    return np.array(found)


@pytest.mark.parametrize("env", [LQR, gs.from_jax(scanned, GAINS)], ids=["torch", "jax"])
def test_gradients_of_a_linear_quadratic_problem_are_those_of_matrix_recursions(env: gs.Environment) -> None:
    x = GAINS.uniform(8, seed=0) / 2
    found, exact = env.evaluate(x), [closed_form(row.view(1, 2).numpy()) for row in x]
    np.testing.assert_allclose(found.loss, [loss for loss, _ in exact], rtol=1e-11)
    np.testing.assert_allclose(found.grad, [slope.ravel() for _, slope in exact], rtol=1e-9)


def test_the_plane_of_two_gains_holds_their_training(tmp_path: Path) -> None:
    (tmp_path / "gd").mkdir()
    trained = descend(tmp_path / "gd")
    cut = gs.slice(LQR, along=f"training:{tmp_path}/gd", resolution=6, out=tmp_path / "cut")
    path = TrainingPath.of(cut.data)
    assert path is not None
    assert path.explained == pytest.approx(1.0, abs=1e-12)
    assert path.farthest == 0
    assert [one.name for one in path.checkpoints] == [f"step{step}.pt" for step in range(12)]  # 9 before 10
    places = torch.tensor([(one.u, one.v) for one in path.checkpoints], dtype=torch.float64)
    np.testing.assert_allclose(cut.plane.lift(places), trained, atol=1e-12)
    np.testing.assert_allclose([one.loss for one in path.checkpoints], [closed_form(K[None])[0] for K in trained])
    grid = cut.plane.grid().reshape(-1, 2).numpy()
    np.testing.assert_allclose(cut.data.loss.to_numpy().ravel(), [closed_form(K[None])[0] for K in grid], rtol=1e-10)
    kept = json.loads((tmp_path / "cut/summary.json").read_text())["training"]
    assert kept["explained"] == path.explained
    assert "all of them in the plane" in path.sentence()
    torch.save({"K": torch.ones(1, 2)}, tmp_path / "gd" / "step12.pt")
    with pytest.raises(ValueError, match="training"):
        gs.slice(LQR, along=f"training:{tmp_path}/gd", resolution=6, out=tmp_path / "cut")


def test_what_a_plane_has_of_a_training_is_what_its_singular_values_say(tmp_path: Path) -> None:
    """Bounds of different widths count: lengths are in half-widths of the box."""
    rng, wide = np.random.default_rng(0), np.array([1.0, 4.0, 2.0, 3.0])
    x = wide * np.cumsum(rng.uniform(-0.1, 0.1, (9, 4)), axis=0)
    for number, row in enumerate(x):
        np.save(tmp_path / f"{number}.npy", row)
    space = gs.ParameterSpace(["a", "b", "c", "d"], -wide, wide)
    bowl = gs.from_torch(lambda x: (x**2).sum(dim=1), space, name="bowl")
    path = TrainingPath.of(gs.slice(bowl, along=f"training:{tmp_path}", resolution=4).data)
    sizes = np.linalg.svd((x - x[-1]) / wide, compute_uv=False) ** 2
    assert path.explained == pytest.approx(sizes[:2].sum() / sizes.sum())
    off = np.array([one.distance for one in path.checkpoints])
    assert (off**2).sum() == pytest.approx(sizes[2:].sum())
    assert off[-1] == pytest.approx(0, abs=1e-12)


def test_filter_normalised_directions_have_the_norms_of_the_points_filters() -> None:
    x = NET.uniform(1, seed=3)[0]
    found, _ = filter_directions(NET, x, 0, "net")
    rows = [(0, 4), (4, 8), (8, 12), (15, 18), (18, 21)]
    for direction in found:
        norms = [np.linalg.norm(direction[low:high]) for low, high in rows]
        np.testing.assert_allclose(norms, [float(x[low:high].norm()) for low, high in rows])
        assert not direction[[12, 13, 14, 21, 22]].any()  # biases
    flax = gs.ParameterSpace.of_weights({"kernel": (3, 3, 1, 2), "bias": (2,)}, outputs="last")
    assert [len(own) for own in flax.filters] == [9, 9]
    assert flax.filters[1].tolist() == list(range(1, 18, 2))


def test_a_filter_normalised_plane_of_gains_is_the_closed_form(tmp_path: Path) -> None:
    at = torch.tensor([1.5, 1.0], dtype=torch.float64)
    cut = gs.slice(LQR, along="filters:0", through=at, resolution=7)
    np.testing.assert_allclose(cut.plane.basis.norm(dim=1), [float(at.norm())] * 2)
    assert (cut.plane.lower.tolist(), cut.plane.upper.tolist()) == ([-1, -1], [1, 1])
    grid, status = cut.plane.grid().reshape(-1, 2), cut.data.status.to_numpy().ravel()
    assert (status == Status.OK).all()
    exact = [closed_form(K.view(1, 2).numpy()) for K in grid]
    np.testing.assert_allclose(cut.data.loss.to_numpy().ravel(), [loss for loss, _ in exact], rtol=1e-10)
    slopes = np.array([cut.plane.basis.numpy() @ slope.ravel() for _, slope in exact])
    np.testing.assert_allclose(cut.slope.reshape(-1, 2), slopes, rtol=1e-7, atol=1e-7)
    with pytest.raises(ValueError, match="all filters of lqr are zero at this point"):
        gs.slice(LQR, along="filters:0", resolution=3)
    plain = gs.from_torch(rolled, gs.ParameterSpace.box(["a", "b"], -1, 1), name="plain")
    with pytest.raises(ValueError, match="plain does not say which of its 2 parameters are the weights of one neuron"):
        gs.slice(plain, along="filters:0", resolution=3)


def agent(path: Path, arrays: dict[str, torch.Tensor], inner: str = "policy.pth") -> None:
    """Leave a zip of the layout that Stable-Baselines3 documents."""
    with zipfile.ZipFile(path, "w") as held:
        held.writestr("data", "{}")
        with held.open(inner, "w") as file:
            torch.save(arrays, file)


def arrays_of(x: torch.Tensor, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
    parts = x.split([12, 3, 6, 2])
    return {name: part.view(shape) for name, part, shape in zip(names, parts, NET.arrays.values(), strict=True)}


PPO = ("mlp_extractor.policy_net.0.weight", "mlp_extractor.policy_net.0.bias", "action_net.weight", "action_net.bias")
SAC = ("actor.latent_pi.0.weight", "actor.latent_pi.0.bias", "actor.mu.weight", "actor.mu.bias")
OWN = tuple(NET.arrays)
VALUES = {"log_std": torch.ones(2), "value_net.weight": torch.ones(1, 3), "critic.qf0.0.weight": torch.ones(3, 6)}
SAVED: dict[str, tuple[str, Callable[[Path, torch.Tensor], object]]] = {
    "a state dict": ("a.pt", lambda path, x: torch.save(arrays_of(x, OWN), path)),
    "one of other names": ("a.pth", lambda path, x: torch.save(arrays_of(x, ("a", "b", "c", "d")), path)),
    "one in a training's": (
        "a.pt", lambda path, x: torch.save({"epoch": 3, "model": arrays_of(x, OWN), "optimizer": {"state": {}}}, path)
    ),
    "one with counters": (
        "a.pt", lambda path, x: torch.save({**arrays_of(x, ("a", "b", "c", "d")), "seen": torch.tensor(7)}, path)
    ),
    "of half precision": ("a.pt", lambda path, x: torch.save(arrays_of(x.float().bfloat16(), OWN), path)),
    "a vector of torch": ("a.pt", lambda path, x: torch.save(x, path)),
    "a vector of NumPy": ("a.npy", lambda path, x: np.save(path, x.numpy())),
    "arrays of NumPy": ("a.npz", lambda path, x: np.savez(path, **arrays_of(x, OWN))),
    "PPO's": ("a.zip", lambda path, x: agent(path, {**VALUES, **arrays_of(x, PPO)})),
    "SAC's": ("a.zip", lambda path, x: agent(path, {**arrays_of(x, SAC), **VALUES})),
}  # fmt: skip


@pytest.mark.parametrize(("name", "save"), SAVED.values(), ids=SAVED.keys())
def test_a_checkpoint_is_read_as_it_was_saved(name: str, save: Callable[..., object], tmp_path: Path) -> None:
    x = torch.round(NET.uniform(1, seed=1)[0])  # which half precision holds
    save(tmp_path / name, x)
    assert torch.equal(read_checkpoint(tmp_path / name, NET, "net"), x)


class Trap:
    """What a pickle would run."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("sprung"),)


REFUSED: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "of another shape": (
        "a.pt", lambda path: torch.save(arrays_of(torch.zeros(23), OWN) | {"1.weight": torch.zeros(2, 4)}, path),
        r"net takes 1.weight of shape \(2, 3\); .*a.pt has 1.weight of shape \(2, 4\)",
    ),
    "of other arrays": (
        "a.zip", lambda path: agent(path, {"q_net.0.weight": torch.zeros(3, 4)}),
        r"net takes 4 arrays of 23 numbers \(0.weight \(3, 4\), .*a.zip has 1 arrays of 12 numbers",
    ),
    "too long a vector": ("a.npy", lambda path: np.save(path, np.zeros(24)), "has 1 arrays of 24 numbers"),
    "not finite": ("a.npy", lambda path: np.save(path, np.full(23, np.nan)), "23 numbers that are not finite"),
    "no policy": ("a.zip", lambda path: agent(path, {}, "other.pth"), "a zip without policy.pth"),
    "no file of torch": ("a.pt", lambda path: path.write_bytes(b"PK none"), "cannot be read as a checkpoint"),
    "what runs": ("a.pt", lambda path: torch.save({"w": Trap()}, path), "cannot be read as a checkpoint"),
    "two state dicts": (
        "a.pt", lambda path: torch.save({"a": {"w": torch.ones(1)}, "b": {"w": torch.ones(1)}}, path), "2 state dicts"
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "save", "said"), REFUSED.values(), ids=REFUSED.keys())
def test_what_is_no_checkpoint_of_these_weights_is_refused_by_name(
    name: str, save: Callable[[Path], object], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save(tmp_path / name)
    with pytest.raises(ValueError, match=said):
        read_checkpoint(tmp_path / name, NET, "net")
    assert not (tmp_path / "sprung").exists()


def test_too_few_checkpoints_and_those_beyond_the_bounds_are_refused(tmp_path: Path) -> None:
    for number in range(2):
        np.save(tmp_path / f"{number}.npy", np.full(2, 3.0 + number))
    plain = gs.from_torch(rolled, gs.ParameterSpace.box(["a", "b"], -6.0, 6.0), name="plain")
    with pytest.raises(ValueError, match=r"needs at least three checkpoints .*has 2"):
        Training.read(tmp_path, plain)
    np.save(tmp_path / "2.npy", np.array([1.0, -8.0]))
    with pytest.raises(ValueError, match=r"1 of 3 checkpoints .* outside the bounds of plain: b is -8, bounds -6 to 6"):
        Training.read(tmp_path, plain)
    cut = gs.slice(LQR, along=f"training:{tmp_path}", resolution=3)  # weights mean something beyond their bounds
    assert (cut.data.status == Status.OK).all()


@pytest.mark.parametrize(
    ("shapes", "said"),
    [({"w": (2, 0)}, "a side of w is a whole number of at least 1"), ({"w": (2,), "b": (1,)}, "got none of b")],
)
def test_what_is_no_shape_of_weights_is_refused(shapes: dict[str, tuple[int, ...]], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        gs.ParameterSpace.of_weights(shapes, {"w": 1.0})
