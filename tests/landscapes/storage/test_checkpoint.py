"""The checkpoint of a study: its parts say which study they are of, and are verified before it continues."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import gradscape as gs
from gradscape.envs.adapters import from_torch
from gradscape.landscapes.identity import DamagedError, StoreError, StoreMismatchError
from gradscape.landscapes.space import ParameterSpace
from gradscape.landscapes.storage.checkpoint import Checkpoint
from gradscape.landscapes.storage.files import holding

SPACE = ParameterSpace({"x": (-1, 1), "y": (-1, 1)})
BOWL, CUP = (from_torch(lambda x, k=k: (k * x**2).sum(dim=1), SPACE, name="bowl") for k in (1.0, 2.0))


def study(folder: Path, seed: int = 0, *, force: bool = False) -> Checkpoint:
    return Checkpoint.open(folder, {"seed": seed}, what="pairs", force=force)


def test_a_part_of_another_study_or_of_an_earlier_version_is_damaged_and_computed_again(tmp_path: Path) -> None:
    for seed in (0, 1):
        study(tmp_path / str(seed), seed).save("one", limit=np.array(0.1 / (1 + 16 * seed)))
    pieces = tmp_path / "0/pieces"
    assert float(study(tmp_path / "0", 0).load("one")["limit"]) == 0.1  # type: ignore[index] # it is there
    shutil.copy(tmp_path / "1/pieces/one.npz", pieces)
    np.savez(pieces / "two.npz", piece=np.array("two"), loss=np.zeros(3))  # which do not say
    for name in ("one", "two"):
        said = rf"{name}\.npz is damaged \(it belongs to another study, or to an earlier version.*computed again"
        with pytest.warns(RuntimeWarning, match=said):
            assert study(tmp_path / "0", 0).load(name) is None
    study(tmp_path / "0").verify(BOWL)  # it begins again
    study(tmp_path / "0").verify(BOWL)


@pytest.mark.slow
def test_a_limit_is_not_moved_by_a_piece_of_another_seed(tmp_path: Path) -> None:
    how = {"points": 2, "settings": ["dt"], "precisions": ["float64"], "device": "cpu", "fidelity": "draft"}
    found = [gs.study("extremes", "bounce", **how, seed=seed, out=tmp_path / str(seed)) for seed in (0, 1)]
    for piece in (tmp_path / "1/pieces").glob("*.npz"):
        shutil.copy(piece, tmp_path / "0/pieces" / piece.name)
    (tmp_path / "1/pieces/probes.npz").replace(tmp_path / "0/pieces/probes.npz")
    with pytest.raises(DamagedError, match=r"probes\.npz is damaged \(it belongs to another study"):
        gs.study("extremes", "bounce", **how, seed=0, out=tmp_path / "0")
    (tmp_path / "0/pieces/probes.npz").unlink()
    with pytest.warns(RuntimeWarning, match="belongs to another study"):
        again = gs.study("extremes", "bounce", **how, seed=0, out=tmp_path / "0")
    assert [one.stable for one in again.limits] == [one.stable for one in found[0].limits]


def test_a_study_goes_on_with_the_same_objective_alone(tmp_path: Path) -> None:
    study(tmp_path).verify(BOWL)
    study(tmp_path).save("one", loss=np.zeros(3))
    assert (study(tmp_path).names(), study(tmp_path).count()) == (["one"], 1)
    study(tmp_path).verify(BOWL)
    with pytest.raises(StoreMismatchError, match=r"a study of bowl whose losses have changed: \S+ then, \S+ now"):
        study(tmp_path).verify(CUP)
    line = from_torch(lambda x: (x**2).sum(dim=1), ParameterSpace({"x": (-1, 1)}), name="bowl")
    with pytest.raises(StoreMismatchError, match="is a study of 2 parameters, but bowl has 1"):
        study(tmp_path).verify(line)
    study(tmp_path, force=True).verify(CUP)


def test_a_study_without_what_it_began_with_is_refused_by_name(tmp_path: Path) -> None:
    study(tmp_path).verify(BOWL)
    study(tmp_path).save("one", loss=np.zeros(3))
    probes = tmp_path / "pieces/probes.npz"
    content = probes.read_bytes()
    for damaged in (content[: len(content) // 2], b""):
        probes.write_bytes(damaged)
        with pytest.raises(DamagedError, match=r"probes\.npz is damaged.*--force"):
            study(tmp_path).verify(BOWL)
    probes.unlink()
    with pytest.raises(DamagedError, match=r"probes\.npz is damaged \(it is missing"):
        study(tmp_path).verify(BOWL)


def test_several_objectives_of_a_study_are_verified_by_themselves(tmp_path: Path) -> None:
    study(tmp_path).verify(BOWL, of="bowl")
    study(tmp_path).save("bowl", loss=np.zeros(3))
    study(tmp_path).verify(CUP, of="cup")
    study(tmp_path).save("cup", loss=np.zeros(3))
    assert study(tmp_path).names() == ["bowl", "cup"]
    study(tmp_path).verify(BOWL, of="bowl")
    with pytest.raises(StoreMismatchError, match="losses have changed"):
        study(tmp_path).verify(BOWL, of="cup")


def test_a_study_that_another_process_fills_is_not_begun_anew(tmp_path: Path) -> None:
    study(tmp_path).save("one", loss=np.zeros(3))
    with holding(tmp_path), pytest.raises(StoreError, match="is being filled by another process, so it is not started"):
        study(tmp_path, force=True)
    assert study(tmp_path).names() == ["one"]
    assert not study(tmp_path, force=True).names()


def test_a_study_of_which_every_point_fails_is_verified_by_that(tmp_path: Path) -> None:
    broken = from_torch(lambda x: x.sum(dim=1) * torch.nan, SPACE, name="bowl")
    study(tmp_path).verify(broken)
    study(tmp_path).verify(broken)
    with pytest.raises(StoreMismatchError, match="points end differently: NONFINITE then, OK now"):
        study(tmp_path).verify(BOWL)
