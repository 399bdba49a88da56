"""The C++ headers compile without a warning: alone, for a CPU and for a GPU as tests emulate it, and in kernels."""

import shutil
import subprocess
from pathlib import Path

import pytest
import warp as wp

from gradscape.envs.engines import cpp
from gradscape.envs.engines.mpm.boundaries import Kind, LadleInTank, Tool, ToolsInRoom
from gradscape.envs.engines.mpm.grid import velocity_on
from gradscape.envs.engines.mpm.materials import Fluid, Plasticine
from gradscape.envs.engines.mpm.smoothing import smoothing_kernels
from gradscape.envs.engines.mpm.transfers import transfers
from gradscape.envs.engines.sheets.contact import Pan, contact_kernel_in_rows
from gradscape.envs.engines.sheets.springs import spring_kernels_in_rows

CLANGS = "EightInts"  # a header with these vectors only clang compiles, and so Warp
HEADERS = sorted(path.name for path in cpp.HEADERS.glob("*.h") if CLANGS not in cpp.whole_text(path.name))
STRICT = '#pragma clang diagnostic error "-Wall"\n#pragma clang diagnostic error "-Wextra"\n'
IN_ROWS = {
    "transfers": lambda: transfers("float32").p2g,
    "smoothing": lambda: smoothing_kernels("float32").spread,
    "fluid": lambda: Fluid(1.0, 1.0, 1.0).kernels("float32")[0],
    "plasticine": lambda: Plasticine(1.0, 1.0, 0.3, 1.0).kernels("float32")[0],
    "tank": lambda: velocity_on("float32", LadleInTank(*[0.1] * 7), columns=False),
    "springs": lambda: spring_kernels_in_rows("float32").pull,
    "contact": lambda: contact_in_rows("float32"),
    "room": lambda: velocity_on("float32", ROOM, columns=False),
}


def contact_in_rows(name):
    pan = Pan(0.1, 0.1, 1.0, 0.1)
    return contact_kernel_in_rows(name, pan.stop(name, "end"), pan.function(name)[1], pan.inside, "end")


ROOM = ToolsInRoom((Tool(Kind.SPHERE, (0.1,), 0.1),), (0.0,) * 3, (1.0,) * 3, 0.0, 0.1, 1.0)


@pytest.mark.parametrize("on", ["cpu", "gpu"])
@pytest.mark.parametrize("header", HEADERS)
def test_a_header_compiles_alone_without_a_warning(header, on, tmp_path):
    if (compiler := shutil.which("g++")) is None:
        pytest.skip("no g++")
    emulated = '#include "builtin.h"\n#undef __CUDA_ARCH__\n#include "emulation.h"\n' if on == "gpu" else ""
    source = tmp_path / "source.cpp"
    source.write_text(f'{emulated}#include "{header}"\n')
    found = ["-isystem", Path(wp.__file__).parent / "native", "-isystem", Path(__file__).parent / "mpm"]
    flags = ["-std=c++20", "-Wall", "-Wextra", "-Werror", "-Wno-unknown-pragmas", "-fsyntax-only"]
    done = subprocess.run([compiler, *flags, *found, "-I", cpp.HEADERS, source], capture_output=True, text=True)
    assert not done.stderr


@pytest.mark.parametrize("kind", IN_ROWS)
def test_kernels_of_a_cpu_compile_without_a_warning_of_a_header(kind, tmp_path, monkeypatch, capfd):
    """By Warp's own compiler, clang, to which what comes before and after the headers may be as it is."""
    module = IN_ROWS[kind]().module
    strict = f"#pragma clang diagnostic push\n{STRICT}{cpp.whole_text('cpu.h')}\n#pragma clang diagnostic pop\n"
    build = wp.ModuleBuildOptions(extra_cpu_preamble=strict)
    for name, value in {"extra_build_options": build, "optimization_level": 0}.items():
        monkeypatch.setitem(module.options, name, value)
    module.mark_modified()
    wp.compile_aot_module(module, device="cpu", module_dir=tmp_path)
    monkeypatch.undo()
    module.mark_modified()
    assert list(tmp_path.glob("*.o"))
    assert "warning" not in capfd.readouterr().err
