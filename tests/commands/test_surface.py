"""`landscape surface`: what it leaves and refuses."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gradscape.cli import main


@pytest.fixture
def run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], tuple[int, str]]:
    monkeypatch.chdir(tmp_path)

    def command(text: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["landscape", *text.split()])
        with pytest.raises(SystemExit) as left:
            main(text.split())
        return int(left.value.code or 0), capsys.readouterr().err

    return command


@pytest.mark.drawn
def test_a_slice_with_a_run_becomes_a_surface(run: Callable[[str], tuple[int, str]]) -> None:
    assert run("slice bounce --dims 0 1 --resolution 5 --out cut --device cpu")[0] == 0
    assert run("optimize bounce --method random --budget 4 --out r --device cpu")[0] == 0
    assert run("optimize ackley --method random --budget 4 --out other")[0] == 0
    code, said = run("surface cut r --out s")
    assert code == 0, said
    assert sorted(file.name for file in Path("s").iterdir()) == ["surface.gltf", "surface.png"]
    assert run("surface cut")[0] == 0
    assert len(list(Path("out").glob("surface-bounce-*"))) == 1
    code, said = run("surface cut other")
    assert (code, "of different landscapes: objective is 'bounce'" in " ".join(said.split())) == (2, True)
    Path("full").mkdir()
    Path("full/notes.txt").write_text("")
    code, said = run("surface cut --out full")
    assert (code, "full holds other files and no surface: notes.txt" in said) == (2, True)
