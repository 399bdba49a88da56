"""Values that end with a message: options every scene has, paths with markup, loops, bytes that are no text, depth."""

import ast
import os
import re
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
from rich.progress import Progress

import gradscape
from gradscape import Environment
from gradscape.cli import Option, verbs
from gradscape.commands.terminal import Console, Described
from gradscape.envs.registry import make
from gradscape.landscapes.storage.files import make_folder, resolve

from .command import SMALL, Run

DEEP = "/".join(["d"] * 2000)
HOSTILE = ["[/b]", "loop", "caf\udce9"]
ROOT = Path(gradscape.__path__[0])
SOURCES = [*ROOT.glob("*.py"), *ROOT.glob("*/*.py"), *ROOT.glob("*/*/*.py")]
VERBS = {tuple(words.split()): verb for words, verb in verbs().items() if words not in ("info", "plan")}
WORDS = {verb: next(words for line in SMALL if (words := line.split())[: len(verb)] == [*verb]) for verb in VERBS}
PATHS = [  # of what a verb says that it is a file or a folder
    (verb, option)
    for verb, one in VERBS.items()
    for option in one.options
    if re.search(r"(?i)file|folder", option.help)
]


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a loop, where what is valid is stopped and not computed."""

    def stopped(*given: object, **options: object) -> Any:
        raise KeyboardInterrupt

    for name in ("jobs.slice.SliceJob.cost", "gallery.site.build.build_site"):
        monkeypatch.setattr(f"gradscape.{name}", stopped)
    monkeypatch.setattr(Environment, "evaluate", stopped)
    (tmp_path / "loop").symlink_to("loop")
    return tmp_path


def said_with(verb: tuple[str, ...], option: Option, value: str) -> list[str]:
    """Return a verb's words with a value for an option, or for one of its arguments."""
    words = list(WORDS[verb])
    if option.names[0].startswith("-"):
        return [*words, option.names[0], value]
    places = [other.names[0] for other in VERBS[verb].options if not other.names[0].startswith("-")]
    at = len(verb) + places.index(option.names[0])
    end = next((place for place, word in enumerate(words) if word.startswith("-")), len(words))
    return [*words[:at], value, *words[at + (at < end) :]]


def test_a_path_nobody_meant_ends_with_a_message(run: Run, desk: Path) -> None:
    for words in (said_with(verb, option, value) for verb, option in PATHS for value in HOSTILE):
        done = run(*words)
        assert done.returncode in (0, 1, 2, 130), (words, done.stderr)
        assert done.returncode == 0 or done.stderr.strip(), words
        assert "\\[" not in done.stdout + done.stderr, words


def test_an_option_of_a_scene_is_not_called_as_what_every_scene_has(run: Run, desk: Path) -> None:
    """Whatever `make` and a scene's class take themselves, and are given by the verb's own options."""
    names = sorted({*signature(make).parameters, *signature(Environment.__init__).parameters})
    setting = [verb for verb, one in VERBS.items() if any(option.names == ("--set",) for option in one.options)]
    for words in ([*WORDS[verb], "--set", f"{name}=1"] for verb in setting for name in names):
        done = run(*words)
        assert done.returncode == 2, words
        assert len(done.stderr.splitlines()) == 1, words
        assert words[-1].removesuffix("=1") in done.stderr, words
    assert [one.name for one in desk.iterdir()] == ["loop"]


def test_a_console_prints_what_it_is_given(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(width=80)
    with console.status("[/b] :warning:") as status, Progress(Described(), console=console) as bar:
        status.update("[/c]")
        bar.add_task("[/d] :warning:")
        console.print("[/e] :warning:")
    said = capsys.readouterr().out
    assert "[/e] :warning:" in said
    assert "[/d] :warning:" in said


def test_every_console_is_that_one() -> None:
    """What rich prints by itself reads markup in it, so that all of ours go through one class."""
    assert len(SOURCES) > 150
    for file in SOURCES:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and file.parent.name != "api":
                assert node.module not in ("rich.console", "rich.markup", "rich.status"), file
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "TextColumn":
                assert "{" not in str(getattr(node.args[0], "value", "")), file  # `Described` shows what is a value


def test_a_folder_is_made_however_deep(tmp_path: Path) -> None:
    deep = tmp_path / "/".join(["d"] * 1200)
    make_folder(deep)
    assert deep.is_dir()
    make_folder(deep)
    for folder in (deep, *deep.parents[:1199]):  # one by one: what clears a test's folder away calls itself for each
        folder.rmdir()


def test_a_loop_of_links_is_no_path(desk: Path) -> None:
    for path in (desk / "loop", desk / "loop/x"):
        with pytest.raises(ValueError, match=r"loop.* leads in a circle of symbolic links; use another path"):
            resolve(path)
    assert resolve(desk / "not/there") == Path(os.path.realpath(desk)) / "not/there"


def test_a_path_too_long_for_the_system_ends_in_a_line(run: Run, desk: Path) -> None:
    done = run("slice", "branin", "--dims", "0", "1", "--out", f"{DEEP}/{DEEP}")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "file name too long; use another path" in done.stderr
