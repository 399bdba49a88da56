"""What `landscape optimize`, `race`, `league` and `methods` refuse: in one line, with exit code 2, leaving nothing."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ..command import Said

SEARCH = "optimize branin --method"
REFUSED = {
    "optimize brannin --method random": "did you mean branin?",
    f"{SEARCH} cma": "no method is called 'cma'; did you mean cma-es?",
    f"{SEARCH} random --budget 0": "--budget",
    f"{SEARCH} random --seed -1": "--seed",
    f"{SEARCH} random --option sigma=1": "random has no option 'sigma'",
    f"{SEARCH} cma-es --option sigma=big": "sigma takes a number; got 'big'",
    f"{SEARCH} cma-es --option sigma": "--option takes name=value; got 'sigma'",
    f"{SEARCH} cma-es --option sigma=0": "from 1e-09 to 1000; got 0.0",
    f"{SEARCH} random --fidelity best": "has fidelities exact; got 'best'",
    f"{SEARCH} random --set dim=3": "branin has no option 'dim'",
    "methods newton": "no method is called 'newton'",
    "race nothing": "no environment is called 'nothing'",
    "race branin --methods random,magic": "no method is called 'magic'",
    "race branin --methods random --option cma-es.sigma=1": "METHOD.NAME=VALUE for one of random",
    "race branin --methods cma-es --option cma-es.speed=1": "cma-es has no option 'speed'",
    "race branin --seeds 0": "--seeds",
    "race branin --workers 2 --scheduler local:2": "--scheduler has workers of its own",
    "league nothing": "no environment is called 'nothing'",
    "league branin@best": "branin has fidelities exact",
    "league branin --seeds 0": "--seeds",
    "league branin --workers 2 --scheduler local:2": "--scheduler has workers of its own",
}


@pytest.mark.parametrize("command", REFUSED)
def test_bad_input_gets_one_line_and_leaves_nothing(run: Callable[..., Said], tmp_path: Path, command: str) -> None:
    done = run(*command.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("landscape: ")
    assert len(done.stderr.splitlines()) == 1
    assert REFUSED[command] in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("force", [[], ["--force"]])
@pytest.mark.parametrize(
    ("command", "file", "what"),
    [
        (f"{SEARCH} random", "progress.png", "run"),
        ("race branin --methods random", "thesis.tex", "race"),
        ("league branin --methods random", "thesis.tex", "league"),
    ],
)
def test_a_folder_of_other_files_is_left_alone(
    run: Callable[..., Said], tmp_path: Path, command: str, file: str, what: str, force: list[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / file).write_text("precious")
    done = run(*command.split(), "--out", "mine", *force, cwd=tmp_path)
    assert done.returncode == 2
    assert f"holds other files and no {what}" in done.stderr
    assert (tmp_path / "mine" / file).read_text() == "precious"
