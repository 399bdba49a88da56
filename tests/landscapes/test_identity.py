"""Identity: results of any other release continue; those of another model are refused, and both versions named."""

import json
from pathlib import Path

import pytest
import torch
import zarr

import gradscape as gs
from gradscape.envs.functions import Branin
from gradscape.jobs.search import run_identity
from gradscape.landscapes import identity
from gradscape.landscapes.identity import (
    StoreMismatchError,
    check_identity,
    current_identity,
    stored_identity,
    stored_provenance,
)
from gradscape.landscapes.plane import Plane
from gradscape.landscapes.sampling.fill import sample
from gradscape.landscapes.storage.arrays import consolidate
from gradscape.landscapes.storage.checkpoint import SETTINGS, Checkpoint
from gradscape.landscapes.storage.store import SliceStore, open_slice
from gradscape.optim.registry import optimizer_class
from gradscape.optim.runs.store import Journal, RunStore, digest_of

from .storage.stores import unpacked

OLD = {"code": "9b9583bcc31d", "gradscape": "0.1.0"}  # what identities held before there were versions
NOW = {"objective": "branin", "model_version": 1, "seed": 0}


def before(whole: dict[str, object]) -> dict[str, object]:
    """Return an identity as earlier releases wrote it."""
    digests = {"method_code": "0763b8a9b2bc"} if "method_version" in whole else {}
    kept = {name: value for name, value in whole.items() if name not in ("model_version", "method_version")}
    return {**kept, **digests, **OLD}


def rewrite(place: Path, found: dict[str, object], *, text: bool) -> zarr.Group:
    """Let a store on disk have an identity, with a provenance of no versions."""
    group = zarr.open_group(place, mode="r+")
    both = {"identity": found, "provenance": {"command": "x"}}
    group.attrs.update({name: json.dumps(value) if text else value for name, value in both.items()})
    consolidate(place)
    return group


@pytest.fixture
def branin() -> gs.Environment:
    return gs.make("branin")


def test_a_slice_of_before_there_were_versions_goes_on(branin, tmp_path):
    plane = Plane.through(branin.space, branin.space.center, (0, 1), resolution=5)
    path, about = tmp_path / "slice.zarr", branin.identity()
    store = SliceStore.create(path, plane, branin.space, identity=about)
    sample(branin, plane, store)
    place = unpacked(path)
    rewrite(place, before(store.identity), text=True)
    again = SliceStore.open_or_create(path, plane, branin.space, identity=about)
    assert again.identity == store.identity
    assert stored_identity(open_slice(path)) == store.identity
    assert stored_provenance(open_slice(path))["versions"] == {"gradscape": "0.1.0"}
    assert json.loads(zarr.open_group(place, mode="r").attrs["identity"])["code"] == OLD["code"]  # as it was written


def test_a_run_of_before_there_were_versions_goes_on(branin, tmp_path):
    kind = optimizer_class("random")
    about = run_identity(branin, kind.on(branin, seed=0, options=kind.Options()))
    assert about["method_version"] == 1
    path = tmp_path / "run.zarr"
    run = RunStore.open_or_create(path, branin.space, identity=about, budget=4)
    group = rewrite(path, before(run.identity), text=False)
    Journal(about=digest_of(group.attrs.asdict())).write(path)
    again = RunStore.open_or_create(path, branin.space, identity=about, budget=4)
    assert again.identity == run.identity == stored_identity(again.dataset())
    assert stored_provenance(again.dataset())["versions"] == {"gradscape": "0.1.0"}


def test_a_study_of_before_there_were_versions_goes_on(branin, tmp_path):
    about = {**branin.identity(), "points": 3}
    Checkpoint.open(tmp_path, about, what="census").save("one", x=torch.ones(1).numpy())
    found = json.loads((tmp_path / SETTINGS).read_text())
    (tmp_path / SETTINGS).write_text(json.dumps(before(found)))
    assert Checkpoint.open(tmp_path, about, what="census").names() == ["one"]


def test_another_release_goes_on_and_its_version_is_kept_as_provenance(branin, tmp_path, monkeypatch):
    how = {"dims": (0, 1), "resolution": 5, "out": tmp_path / "cut"}
    first = gs.slice(branin, **how)
    assert first.provenance["versions"]["gradscape"] == gs.__version__
    for module in (identity, gs):
        monkeypatch.setattr(module, "__version__", "9.9.9")
    assert gs.slice(branin, **how).data["loss"].identical(first.data["loss"])


def test_another_model_is_refused_by_both_versions_and_another_setting_beside_it_is_named(
    branin, tmp_path, monkeypatch
):
    how = {"dims": (0, 1), "resolution": 5, "out": tmp_path / "cut"}
    gs.slice(branin, **how)
    monkeypatch.setattr(Branin, "model_version", 2)
    said = r"was made by branin model 1; this is model 2\. Use --out, or --force to replace it\."
    with pytest.raises(StoreMismatchError, match=said):
        gs.slice(gs.make("branin"), **how)
    with pytest.raises(StoreMismatchError, match=r"model_version: wanted 2, found 1; seed: wanted 5, found 0"):
        check_identity(None, wanted={**NOW, "model_version": 2, "seed": 5}, found=NOW)


def test_an_identity_of_now_stays_as_it_is_and_one_without_a_model_gets_none():
    assert current_identity(NOW) == NOW
    assert current_identity({"objective": "bowl", "gradscape": "0.1.0"}) == {"objective": "bowl"}
    assert current_identity(before(NOW)) == NOW
