"""Programs of JAX that are kept: what is found again, and what is not."""

import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from jax.experimental.compilation_cache import compilation_cache

from gradscape.envs.engines import jax_programs
from gradscape.envs.engines.jax_functions import JaxFunction, compiled, computing_in
from gradscape.envs.engines.jax_programs import keep_compiled, source_digest

X = torch.tensor([[0.3, 0.7], [0.5, -0.2]], dtype=torch.float64)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Let programs be kept in a folder of this test's, however quickly they compile."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    changed = ("jax_compilation_cache_dir", *(name for name, *_ in jax_programs.LIMITS))
    before = {name: jax.config.values[name] for name in changed}
    jax.config.update("jax_compilation_cache_dir", None)
    keep_compiled()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()
    yield jax_programs.user_folder()
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


class Wave:
    """A function that counts how often it is traced."""

    def __init__(self) -> None:
        self.traced = 0

    def __call__(self, x):
        self.traced += 1
        return jnp.sin(x[0]) * x[1] ** 2 + jnp.linalg.solve(jnp.eye(2) + 0.1 * jnp.outer(x, x), x)[0]

    def evaluate(self, key: str, *, precision: str = "float64", mode: str = "reverse", rows: int = 2):
        """Return the losses and gradients of a new function of this, as another process has one."""
        before = self.traced
        found = JaxFunction(self, 2, "wave", precision, rows, mode, key=key)(X, True)
        return found, self.traced - before


def test_a_kept_program_gives_the_same_bits_and_calls_no_function():
    wave = Wave()
    (loss, grad, kind), traced = wave.evaluate("wave")
    assert traced == 1
    (again, slope, same), traced = wave.evaluate("wave")
    assert traced == 0
    assert torch.equal(again, loss)
    assert torch.equal(slope, grad)
    assert same == kind == "float64"
    (plain, steep, _), traced = wave.evaluate("")
    assert traced == 1
    assert torch.equal(plain, loss)
    assert torch.equal(steep, grad)


def test_the_same_operations_of_other_code_are_not_compiled_again(folder):
    """Other code has another key, and its lines are elsewhere."""
    evaluate = compile("def evaluate(wave, key): return wave.evaluate(key)", "elsewhere", "exec")
    wave, elsewhere = Wave(), {}
    exec(evaluate, elsewhere)
    (loss, _, _), _ = wave.evaluate("wave")
    (again, _, _), traced = elsewhere["evaluate"](wave, "edited")
    assert traced == 1
    assert torch.equal(again, loss)
    assert [len(list(folder.glob(kept))) for kept in ("traced/*.stablehlo", "*-cache")] == [2, 1]


@pytest.mark.parametrize(
    "other",
    [{"key": "other"}, {"precision": "float32"}, {"mode": "forward"}, {"rows": 1}],
    ids=lambda one: next(iter(one)),
)
def test_another_function_precision_mode_or_batch_is_traced(other):
    wave = Wave()
    wave.evaluate("wave")
    assert wave.evaluate(**{"key": "wave", **other})[1] == 1


def test_with_jaxs_cache_off_nothing_is_kept(folder):
    wave = Wave()
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        assert [wave.evaluate("wave")[1] for _ in range(2)] == [1, 1]
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    assert not folder.exists()


def test_a_folder_that_the_user_chose_stays(tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "chosen"))
    keep_compiled()
    Wave().evaluate("wave")
    assert len(list((tmp_path / "chosen" / "traced").iterdir())) == 1


def cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def flip(content: bytes) -> bytes:
    return content[:200] + bytes([content[200] ^ 1]) + content[201:]


@pytest.mark.parametrize("damage", [cut, flip])
@pytest.mark.parametrize("kept", ["traced/*.stablehlo", "*-cache"])
def test_a_damaged_file_is_made_again(folder, damage, kept):
    """JAX alone would compile for it in each process, and not write it again."""
    wave = Wave()
    (loss, grad, _), _ = wave.evaluate("wave")
    (path,) = folder.glob(kept)
    damaged = damage(path.read_bytes())
    path.write_bytes(damaged)
    (again, slope, _), traced = wave.evaluate("wave")
    assert traced == (1 if kept.startswith("traced") else 0)
    assert torch.equal(again, loss)
    assert torch.equal(slope, grad)
    mended = path.read_bytes()
    assert mended != damaged
    assert wave.evaluate("wave")[1] == 0
    assert path.read_bytes() == mended


def test_where_nothing_can_be_written_it_is_traced(folder):
    folder.mkdir(parents=True)
    (folder / "traced").write_text("a file where a folder should be")
    wave = Wave()
    assert [wave.evaluate("wave")[1] for _ in range(2)] == [1, 1]


def test_what_was_not_used_for_longest_goes(folder, monkeypatch):
    monkeypatch.setattr(jax_programs, "MAX_TRACED", 2)
    wave = Wave()
    for age, key in ((3, "a"), (2, "b")):
        wave.evaluate(key)
        newest = max((folder / "traced").glob("*.stablehlo"), key=lambda path: path.stat().st_mtime)
        os.utime(newest, (time.time() - 100 * age,) * 2)
    wave.evaluate("a")  # used again
    wave.evaluate("c")
    assert [wave.evaluate(key)[1] for key in ("a", "c", "b")] == [0, 0, 1]


def test_what_has_an_effect_is_not_kept(folder):
    said = []

    def talk(x):
        jax.debug.callback(lambda at: said.append(float(at)), x[0])
        return 2 * x

    with computing_in("float64"):
        for _ in range(2):
            jax.block_until_ready(compiled(talk, (2,), "float64", "talk")(np.ones(2)))
    jax.effects_barrier()
    assert said == [1.0, 1.0]


def test_code_that_was_changed_since_this_process_began_has_no_digest(tmp_path, monkeypatch):
    (tmp_path / "loss.py").write_text("HEIGHT = 1.0")
    source_digest.cache_clear()
    assert source_digest(tmp_path) is None
    digests = set()
    for text in ("HEIGHT = 1.0", "HEIGHT = 2.0"):  # of a later process
        (tmp_path / "loss.py").write_text(text)
        monkeypatch.setattr(jax_programs, "IMPORTED_AT", time.time() + 10)
        source_digest.cache_clear()
        digests.add(source_digest(tmp_path))
    source_digest.cache_clear()
    assert len(digests - {None}) == 2
