"""`--json`: one JSON value on standard output, of every verb that returns something, and nothing else there."""

from pathlib import Path

import pytest

from gradscape.cli import verbs

from ..command import Run, make

PRINTED = """
envs
envs branin
methods
methods bo-leap
info
export cut --force
plan slice branin --resolution 4
gallery list .
""".strip().splitlines()
ELSEWHERE = {  # whose JSON other tests read
    *(
        "advise",
        "bench",
        "bounce",
        "card",
        "census",
        "check",
        "compare",
        "gallery compute",
        "hessian",
        "league",
        "optimize",
    ),
    *("overlay", "pairs", "race", "remedy", "replay", "report", "slice", "study", "surface", "sweep"),
}


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("desk"), "slice branin --resolution 4 --out cut")


@pytest.mark.parametrize("words", PRINTED)
def test_what_is_printed_is_json(run: Run, desk: Path, words: str) -> None:
    found = run.json(*words.split(), cwd=desk)
    assert found


def test_every_verb_with_the_option_is_tried() -> None:
    having = {name for name, verb in verbs().items() if any("--json" in one.names for one in verb.options)}
    assert {name for name in having if any(f"{line} ".startswith(f"{name} ") for line in PRINTED)} == having - ELSEWHERE
