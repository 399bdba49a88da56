"""What Warp makes of a kernel for a GPU, run on a CPU: for kernels whose threads talk to each other in warps."""

import ctypes
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pytest
import warp as wp

HEADER = Path(__file__).with_name("emulation.h")
INCLUDES = '#include "builtin.h"\n#include "deterministic.h"\n'
KERNEL = re.compile(
    r'extern "C" (?:__launch_bounds__\(.*?\) )?__global__ void (\w+)_cuda_kernel_forward\((.*?)\)\s*\{', re.DOTALL
)
WRAPPER = """
extern "C" void run_{name}(unsigned rows, unsigned columns, void **given) {{
    wp::launch_bounds_t<2> bounds;
    bounds.shape[0] = rows, bounds.shape[1] = columns, bounds.size = (size_t)rows * columns, bounds.coord_mult = 1;
    launch(bounds.size, [&] {{ {name}_cuda_kernel_forward(bounds, {arguments}); }});
}}
"""


def emulate(kernel: Any, dim: tuple[int, int], inputs: list[Any]) -> None:
    """Launch a kernel on arrays in a CPU's memory as a GPU would, in blocks of warps."""
    held = [_packed(kind, value) for kind, value in zip(kernel.adj.arg_types.values(), inputs, strict=True)]
    pointers = [ctypes.cast(ctypes.byref(one), ctypes.c_void_p) for one in held]
    program = _program(kernel.module)
    (run,) = (name for name in program.names if re.fullmatch(f"{kernel.key}_[0-9a-f]{{8}}", name))
    getattr(program.library, f"run_{run}")(*dim, (ctypes.c_void_p * len(pointers))(*pointers))


class _Program:
    def __init__(self, library: ctypes.CDLL, names: list[str]) -> None:
        self.library, self.names = library, names


@cache
def _program(module: Any) -> _Program:
    """Compile a module's CUDA code for the CPU."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("no g++ that could compile what Warp makes for a GPU")
    folder = Path(mkdtemp())
    try:
        wp.compile_aot_module(module, device=None, arch=90, module_dir=folder, use_ptx=True)
        (file,) = folder.glob("*.cu")
        code = file.read_text()
        found = KERNEL.findall(code)
        assert INCLUDES in code
        assert found
        code = code.replace("#define WP_NO_CRT\n", "").replace(
            INCLUDES, f'{INCLUDES}#undef __CUDA_ARCH__\n#include "{HEADER}"\n'
        )
        code = re.sub(
            r"wp::tile_shared_storage_t(::init\(\)| tile_mem);",
            "",
            re.sub(r'extern "C" (__launch_bounds__\(.*?\) )?__global__', "__global__", code),
        )
        for name, parameters in found:
            kinds = [" ".join(one.split()[:-1]) for one in re.split(r",\n", parameters)[1:]]
            given = ", ".join(f"*({kind} *)given[{number}]" for number, kind in enumerate(kinds))
            code += WRAPPER.format(name=name, arguments=given)
        source, built = folder / "emulated.cpp", folder / "emulated.so"
        source.write_text(code)
        headers = Path(wp.__file__).parent / "native"
        command = [compiler, "-std=c++20", "-O1", "-w", "-fpermissive", "-shared", "-fPIC", "-pthread", f"-I{headers}"]
        done = subprocess.run([*command, source, "-o", built], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-3000:]
        return _Program(ctypes.CDLL(str(built)), [name for name, _ in found])
    finally:
        shutil.rmtree(folder)


def _packed(kind: Any, value: Any) -> Any:
    if isinstance(value, wp.array) or hasattr(value, "__ctype__"):
        return value.__ctype__()
    return {int: ctypes.c_int, wp.int32: ctypes.c_int, wp.float32: ctypes.c_float, wp.float64: ctypes.c_double}[kind](
        value
    )
