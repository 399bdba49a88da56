"""What is compiled before the first evaluation: every kernel that it launches."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import warp as wp

from gradscape.envs.registry import make

pytestmark = pytest.mark.slow

# In a process of its own, since it unloads kernels that solvers of other tests would launch.
PROGRAM = """
import json
import warp as wp
from gradscape.envs.registry import BUILTIN, environment_class, make

def loaded():
    return {f"{name} {variant}" for name, one in modules().items() for variant in one.execs}

def modules():
    return dict(wp._src.context.user_modules)

late = {}
for name in [entry.name for entry in BUILTIN if "draft" in entry.fidelities and not entry.extra]:
    for module in modules().values():
        module.unload()
    env = make(name, device="cpu", fidelity="draft", horizon=0.1)
    env.prepare()
    before = loaded()
    assert before and env.evaluate(env.space.uniform(1, seed=0)).grad is not None
    late[name] = sorted(loaded() - before)
print(json.dumps(late))
"""


def test_a_first_gradient_of_any_scene_loads_no_kernel_that_was_not_prepared() -> None:
    said = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True).stdout
    late: dict[str, list[str]] = json.loads(said.splitlines()[-1])
    assert len(late) > 10
    assert {name: those for name, those in late.items() if those} == {}


@pytest.mark.parametrize(("name", "kept"), [("bounce", False), ("swing-velocity", False), ("fluid", True)])
def test_a_compiler_keeps_headers_only_for_solvers_of_many_modules(
    monkeypatch: pytest.MonkeyPatch, name: str, kept: bool
) -> None:
    usual, seen = wp.config.use_precompiled_headers, set[bool]()
    monkeypatch.setattr(wp, "force_load", lambda *_, **__: seen.add(wp.config.use_precompiled_headers))
    make(name, device="cpu", fidelity="draft", horizon=0.1).prepare()
    assert seen == {kept}
    assert wp.config.use_precompiled_headers == usual
