"""Which nodes a particle meets, as a GPU's compiler makes it; that needs no GPU."""

import re

import pytest
import warp as wp

from gradscape.envs.engines.mpm.columns import GPU_TEAM, cell_kernels, column_kernels
from gradscape.envs.engines.mpm.materials import Fluid
from gradscape.envs.engines.mpm.smoothing import smoothing_columns
from gradscape.envs.engines.mpm.transfers import transfers_of_columns

DEFINED = re.compile(r"^\s*([a-z][\w.]*)\s+(%\w+),", re.MULTILINE)
FLOOR = re.compile(r"cvt\.rmi\S*\s+%\w+, (%\w+)")
KERNELS = {
    "cells": lambda name: cell_kernels(name).count,
    "columns": lambda name: column_kernels(name, GPU_TEAM).p2g,
    "smoothing": lambda name: smoothing_columns(name, GPU_TEAM).spread,
    "transfers": lambda name: transfers_of_columns(name).g2p,
    "fluid": lambda name: Fluid(1.0, 1.0, 1.0).kernels(name, columns=True)[1],
}


@pytest.mark.parametrize(("name", "arch"), [("float32", 75), ("float32", 90), ("float64", 90)])  # Turing's, Hopper's
@pytest.mark.parametrize("kind", KERNELS)
def test_all_kernels_round_alike_where_a_particle_is(kind, name, arch, tmp_path):
    """One that made a product and a sum one operation would find other nodes than the rest, now and then."""
    wp.compile_aot_module(KERNELS[kind](name).module, device=None, arch=arch, module_dir=tmp_path, use_ptx=True)
    (file,) = tmp_path.glob("*.ptx")
    found = []
    for kernel in file.read_text(errors="replace").split(".visible .entry")[1:]:
        made_by = {place: operation for operation, place in DEFINED.findall(kernel)}
        found += [made_by[place] for place in FLOOR.findall(kernel)]
    assert set(found) == {name.replace("float", "add.rn.f")}
