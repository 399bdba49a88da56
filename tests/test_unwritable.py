"""Folders that the system chose and that take nothing: the error says which variable moves them."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gradscape.envs.engines import runtime
from gradscape.envs.mpm import targets
from gradscape.landscapes.storage.files import moved_by
from gradscape.studies import kept, own_folder

from .made_studies import fidelities

pytestmark = pytest.mark.e2e

SLICE = "slice bounce --dims 0 1 --resolution 2 --fidelity draft --device cpu --out made"


@pytest.mark.parametrize("variable", ["WARP_CACHE_PATH", "XDG_CACHE_HOME"])
def test_a_command_without_a_place_for_kernels_names_the_variable_that_moves_them(
    tmp_path: Path, variable: str
) -> None:
    (tmp_path / "file").write_text("in the place of a folder")
    clean = {name: value for name, value in os.environ.items() if name != "WARP_CACHE_PATH"}
    done = subprocess.run(
        [sys.executable, "-m", "gradscape", *SLICE.split()],
        cwd=tmp_path, env=clean | {variable: str(tmp_path / "file")}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"landscape: Warp's kernels cannot be stored at {tmp_path / 'file'}")
    assert line.endswith("(not a directory); set the environment variable WARP_CACHE_PATH to a writable folder")


def test_kernels_that_cannot_be_written_say_so_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", "/cache/warp/module")

    monkeypatch.setattr(runtime.wp, "force_load", refuse)
    with pytest.raises(OSError, match=r"at /cache/warp/module \(permission denied\); .* WARP_CACHE_PATH"):
        runtime.load([], "cpu")


def test_other_folders_of_the_user_say_so_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the place of a folder")
    monkeypatch.setattr(targets, "user_cache_path", lambda name: tmp_path / "file" / name)
    with pytest.raises(OSError, match=r"targets cannot be stored at .* XDG_CACHE_HOME"):
        targets.load_or_make("rope", "content", lambda: np.zeros(1))
    monkeypatch.setattr(own_folder, "user_data_path", lambda name: tmp_path / "file" / name)
    with pytest.raises(OSError, match=r"the measurements cannot be stored at .* XDG_DATA_HOME"):
        kept.keep(replace(fidelities(), identity={"device": "cpu", "options": {}, "model_version": 1}))


def test_a_full_disk_is_no_such_folder() -> None:
    with pytest.raises(OSError, match="No space left") as raised, moved_by("XDG_DATA_HOME", "what was measured"):
        raise OSError(28, "No space left on device", "/data")
    assert raised.type is OSError
