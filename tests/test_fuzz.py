"""The command line and the store reader under what nobody meant them to get."""

import contextlib
import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import typer
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gradscape import Environment, ParameterSpace, Plane, from_torch, open_slice, sample
from gradscape.cli import app, main
from gradscape.landscapes.store import SliceStore

from .command import Said

# The same examples every time: a test that fails now and then helps nobody.
QUIET = settings(derandomize=True, suppress_health_check=list(HealthCheck), database=None)
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
VALID = """
envs branin
slice branin --dims 0 1 --resolution 3 --through center --extent 0.5 --out made
slice ackley --dims x0 x1 --set dim=3 --no-gradients --json
sweep ackley --dims 0 1 --over 2 --set dim=3 --frames 2 --resolution 3
methods cma-es
optimize branin --method cma-es --budget 5 --seed 1 --option sigma=0.2
race branin --methods random,cma-es --budget 5 --seeds 2 --workers 2 --option cma-es.sigma=0.2
overlay cut run --resolution 3 --plane pca
surface cut run
replay bounce --params f.json --no-film
bounce --axis y --resolution 3 --extent 0:1
bench branin --batch 2 --seconds 0
check branin --points 2
tradeoff bounce --points 2 --ladder dt,precision
pairs ackley --samples 2 --top 3
report cut --points 2
plan bounce --dims 0 1 --resolution 3 --workers 2 --over horizon --frames 2
plan f.toml --resolution 3
gallery compute --only bounce --part slices --resolution 3 --data made
gallery list --json
gallery build --out site
""".strip().splitlines()
OPENING = {"--serve", "--spawn"}  # these start viewers, as `view` and `gallery serve` do
WORDS = ["branin", "bounce", "fluid", "x0", "0", "1", "2", "-1", "1e400", "nan", "0.5", "0:1", "center", "random:0"]
WORDS += ["example:aim", "horizon", "smoothing", "random", "cma-es", "draft", "cpu", "dim=3", "=", "dim=", "lr=x", "5%"]
WORDS += ["f.json", "f.toml", "cut", "own", "run", ".", "/", "\0", "", "--", "cut/slice.zarr", "best", "pca", "--none"]


@st.composite
def arguments(draw: st.DrawFn) -> list[str]:
    """A command that is valid but for a few words, which are lost, put in or put in the place of others."""
    said = draw(st.sampled_from(VALID)).split()
    verb = 1 + (said[0] == "gallery")
    command = COMMANDS[said[0]] if verb == 1 else COMMANDS["gallery"].commands[said[1]]
    options = {one for param in command.params for one in param.opts if one.startswith("-")} - OPENING
    word = st.sampled_from(WORDS) | st.sampled_from(sorted(options or {"-h"})) | st.text(max_size=6)
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(verb, len(said)))
        said[at : at + draw(st.integers(0, 2))] = draw(st.lists(word, max_size=2))
    return said


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a slice, one of somebody's own function, and files of no use."""
    folder = tmp_path_factory.mktemp("desk")
    cut = ["slice", "branin", "--dims", "0", "1", "--resolution", "4", "--out", str(folder / "cut")]
    with pytest.raises(SystemExit), contextlib.redirect_stderr(io.StringIO()):
        main(cut)
    store(folder / "own/slice.zarr")
    (folder / "f.json").write_text('{"a": [1, "b"]}')
    (folder / "f.toml").write_text("figure = 3\n")
    (folder / "run").mkdir()
    return folder


@settings(QUIET, max_examples=100)
@given(arguments())
def test_whatever_is_said_ends_with_a_message(
    run: Callable[..., Said], desk: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    """Ctrl-C comes with the first episode or page, so that what is valid is stopped and not computed."""

    def stopped(*given: object, **options: object) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(Environment, "evaluate", stopped)
    monkeypatch.setattr("gradscape.gallery.build.build_site", stopped)
    done = run(*arguments, cwd=desk)
    assert done.returncode in (0, 1, 2, 130), done.stderr
    assert "Traceback" not in done.stderr
    if done.returncode:
        assert done.stderr.strip()
        assert done.stderr.strip() != "None"


SPACE = ParameterSpace.box(["a", "b", "c"], -1.0, 1.0)


def store(path: Path) -> SliceStore:
    plane = Plane.through(SPACE, SPACE.center, ("a", "b"), resolution=12)
    objective = from_torch(lambda x: torch.sin(3 * x).sum(dim=1), SPACE)
    found = SliceStore.create(path, plane, SPACE, identity={"objective": "sines"})
    sample(objective, plane, found)
    return found


def tiles(path: Path) -> None:
    """Leave the tiles of a slice as they are just before it is finished."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SliceStore, "finish", lambda *_: None)
        store(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("whole")
    tiles(folder / "tiles.zarr")
    store(folder / "finished.zarr")
    return {"tiles": folder / "tiles.filling.zarr", "finished": folder / "finished.zarr"}


def damaged(draw: st.DrawFn, file: Path) -> None:
    """Do one thing to a file that disks, copies and hands do."""
    content, ways = file.read_bytes(), ("flip", "cut", "remove", "grow", "empty")
    way = draw(st.sampled_from([*ways, *["edit"] * 4 * (file.suffix == ".json")]))
    if way == "remove":
        file.unlink()
    elif way == "edit":
        file.write_text(json.dumps(edited(draw, json.loads(content))))
    elif way in ("cut", "flip"):
        at = draw(st.integers(0, len(content) - 1))
        flipped = content[at] ^ draw(st.integers(1, 255))
        file.write_bytes(content[:at] + (bytes([flipped]) + content[at + 1 :] if way == "flip" else b""))
    else:
        file.write_bytes(content + draw(st.binary(min_size=1, max_size=9)) if way == "grow" else b"")


def edited(draw: st.DrawFn, value: Any) -> Any:
    """Change or remove something deep inside of a JSON value."""
    if isinstance(value, (dict, list)) and value and draw(st.integers(0, 4)):
        key = draw(st.sampled_from(sorted(value) if isinstance(value, dict) else range(len(value))))
        if draw(st.integers(0, 5)):
            value[key] = edited(draw, value[key])
        else:
            del value[key]
        return value
    return draw(st.sampled_from([None, 0, 1, -1, 7, 1e300, "", "x", [], {}, [1], {"x": 1}, True, "float32", "int64"]))


def opened(path: Path) -> tuple[xr.Dataset | None, str]:
    try:
        return open_slice(path), ""
    except ValueError as error:
        return None, str(error)


@settings(QUIET, max_examples=100)
@given(st.data())
def test_a_damaged_store_is_refused_by_name_or_read_right(
    whole: dict[str, Path], tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Finished points have their values, places and status; what is lost is MISSING, and never a wrong number."""
    kind = data.draw(st.sampled_from(sorted(whole)))
    path = tmp_path_factory.getbasetemp() / "damaged" / whole[kind].name
    shutil.rmtree(path.parent, ignore_errors=True)
    shutil.copytree(whole[kind], path)
    file = data.draw(st.sampled_from(sorted(one for one in path.rglob("*") if one.is_file())))
    damaged(data.draw, file)
    found, said = opened(path)
    if found is None:
        assert str(path) in said
        return
    right = open_slice(whole[kind])
    there = found["status"] > 0
    for name in ("loss", "grad", "status"):
        xr.testing.assert_equal(
            found[name].where(there).drop_attrs(deep=True), right[name].where(there).drop_attrs(deep=True)
        )
    for name in ("u", "v"):
        np.testing.assert_array_equal(found[name], right[name])
