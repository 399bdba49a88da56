"""What README and docs say to type: every command and every block of Python is run, with small sizes.

Cells of tutorials are run when the documentation is built (`make docs`).
"""

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from gradscape.api import view
from gradscape.cli import main, verbs
from gradscape.gallery.files import DATA
from gradscape.jobs.workers import workers

from .command import Run

pytestmark = pytest.mark.docs

ROOT = Path(__file__).parent.parent
ELSE = ("generated", "archive")  # written when the site is built, and of earlier versions
PAGES = [ROOT / "README.md", *(one for one in sorted((ROOT / "docs").rglob("*.md")) if one.parent.name not in ELSE)]
README = PAGES[0].read_text()
TEXT = "\n".join(page.read_text() for page in PAGES)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BLOCKS = [
    block
    for block in re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)
    if not any(name in block for name in ("dask_jobqueue", "from brax", "import genesis"))
]  # what a batch system, Brax and Genesis need is installed by no test
PLACEHOLDER = re.compile(r"\.{3}|[\[\]|]|\b(?!CUDA)[A-Z]{1,}\b")  # in what a command may look like

FUNCTIONS = """
bumps, by_jax, throw = (gs.from_torch(lambda x: (x**2).sum(1), Throw.space, name=name) for name in ("a", "b", "c"))
Spring = gs.from_torch(lambda x: x[:, 0].log(), gs.ParameterSpace({"stiffness": gs.log(1, 1e6, "N/m")}), name="spring")
"""  # what pages call functions of somebody's file
# What makes them small: words in the place of others, the values of options, and options that are added.
WORDS = {"SLICE": "cut", "RUN": "run", "best:RUN": "best:run", "local": "local:1", "cuda": "cpu"}
WORDS |= {
    "tls://10.0.0.5:8786": "ADDRESS",  # of the scheduler that tests start
    "throw": "thrown",
    "flight": "control",
    "standard": "draft",
    "gallery/data/flip-0-1": str(DATA / "flip-0-1"),
    "triple-move": "bounce",
}
VALUES = {"--resolution": "2", "--budget": "3", "--seeds": "1", "--frames": "2", "--points": "2", "--slices": "1"}
VALUES |= {"--power": "20%"}
ADDED = {
    "race": ["--seeds", "1", "--budget", "3", "--device", "cpu"],
    "league": ["--seeds", "1", "--budget", "3", "--device", "cpu"],
    "study": ["--points", "4", "--device", "cpu"],
    "replay": ["--no-film"],
    "bounce": ["--resolution", "3"],
    "slice": ["--resolution", "2"],
    "sweep": ["--resolution", "2"],
    "check": ["--power", "20%"],
    "pairs": ["--samples", "2"],
    "card": ["--scene", "control", "--resolution", "3"],
    "census": ["--slices", "1", "--resolution", "6"],
    "remedy": ["--remedies", "clip:9"],
    "gallery compute": ["--only", "bounce-y", "--part", "slices", "--fidelity", "draft", "--data", "made"],
    "gallery build": ["--data", "few", "--out", "site"],
    "gallery serve": ["--out", "served", "--port", "0"],
}
SCENES = {verb: {"fluid": "bounce", "flip": "bounce"} for verb in ("race", "optimize", "study")}
SCENES["league"] = {"fluid@standard": "branin"}
SCENES["report"] = {"cartpole": "bounce", "SLICE": "branin"}
SCENES["--tolerance"] = {"fluid": "bounce", "6": "0", "8": "1"}
SHORT = {
    "slice": {"fluid", "assembly"},
    "compare": {"fluid"},
    "sweep": {"fluid"},
    "replay": {"fluid"},
    "plan": {"fluid"},
    "race": {"bounce"},
    "optimize": {"bounce"},
    "study": {"bounce", "cartpole"},
    "census": {"bounce"},
    "--tolerance": {"bounce"},
}
TENTH = ["--set", "horizon=0.1"]  # of an episode
TAICHI = ["--no-gradients"]  # whose kernels take minutes to compile with gradients


def typed() -> list[str]:
    """Return every command that the README shows, in blocks and between words, comments left out."""
    lines = re.findall(r"^    (landscape .*)$", TEXT, flags=re.MULTILINE)
    spans = re.findall(r"`(landscape [^`]*)`", TEXT)
    found = [line.partition(" #")[0].strip() for line in lines] + [" ".join(span.split()) for span in spans]
    return list(dict.fromkeys(found))


def verb_of(words: list[str]) -> str:
    return " ".join(words[1:3]) if words[1] == "gallery" else words[1]


def complete(command: str) -> bool:
    """Say whether a command can be typed as it stands, but for folders and addresses."""
    kept = re.sub(r"\b(best:)?(SLICE|RUN|ADDRESS)\b", "x", command)
    return not PLACEHOLDER.search(kept) and len(kept.split()) > 2 + command.startswith("landscape gallery") * 0


def small(command: str) -> list[str]:
    """Return a command's words, as small as it can be and still be the same command."""
    words = shlex.split(command)
    verb = verb_of(words)
    kind = "--tolerance" if "--tolerance" in words else verb
    scenes = SCENES.get(kind, {})
    found = [scenes.get(word, WORDS.get(word, word)) for word in words[1:]]
    values = VALUES | ({"--budget": "16", "--starts": "6"} if verb == "remedy" else {})
    values |= {"--budget": "500"} if "auto" in words else {}
    for at, word in enumerate(found[:-1]):
        found[at + 1] = values.get(word, found[at + 1])
    added = ADDED.get(verb, []) + (TAICHI if "taichi" in found else [])
    pairs = [added[at : at + 2] for at in range(0, len(added), 2)] if verb != "replay" else [added]
    if "mixed" in found:
        found += [] if "--time-limit" in found else ["--time-limit", ""]
        found[found.index("--time-limit") + 1] = "0.01"
    short = TENTH if SHORT.get(kind, set()) & {*found} and "--policy" not in found else []  # which decides whole ones
    return [*found, *(word for pair in pairs if pair[0] not in found for word in pair), *short]


HELP = {"landscape --help", "landscape VERB --help"}  # which test_help.py reads
FORMS = [command for command in typed() if not complete(command) and command not in HELP]
RUN = [command for command in typed() if complete(command)]
# If small, some are equal, or the same words in another order.
ONCE = list({tuple(sorted(small(command))): command for command in reversed(RUN)}.values())


def test_there_are_commands_of_both_kinds() -> None:
    assert len(RUN) > 35
    assert len(FORMS) > 15
    assert {verb_of(shlex.split(command)) for command in RUN} >= {*verbs()} - {
        "gallery compute", "gallery list", "gallery serve", "envs", "info", "bench",
    }  # fmt: skip


def test_forms_name_verbs_and_options_there_are() -> None:
    for command in FORMS:
        words = re.split(r"[\s|\\]+", command.replace("landscape plan ", "landscape "))
        known = verbs() | {"VERB": verbs()["plan"]}
        named = [known[f"gallery {verb}"] for verb in words[2:]] if words[1] == "gallery" else [known[words[1]]]
        for option in (word for word in words if word.startswith("--")):
            assert option in {name for verb in named for one in verb.options for name in one.names}, command


@pytest.fixture(scope="session")  # whose own environments are known to the whole process
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a slice, a run, its points as a table, somebody's own class, two figures, and a site to serve."""
    folder = tmp_path_factory.mktemp("desk")
    for name, text in re.findall(r"```python\n# (\w+\.py)\n(.*?)```", TEXT, flags=re.DOTALL):
        (folder / name).write_text(text)
    with (folder / "my.py").open("a") as file:
        file.write(FUNCTIONS)
    how = ["--fidelity", "draft", "--device", "cpu", "--out"]
    for command in (
        ["slice", "fluid", *TENTH, "--dims", "0", "1", "--resolution", "2", *how, str(folder / "cut")],
        ["optimize", "fluid", *TENTH, "--method", "random", "--budget", "2", *how, str(folder / "run")],
        ["overlay", str(folder / "cut"), str(folder / "run"), "--out", str(folder / "over")],
        ["slice", f"{folder / 'my.py'}:throw", "--resolution", "4", "--out", str(folder / "thrown")],
        ["export", str(folder / "run"), "--to", "csv", "--out", str(folder / "points.csv")],
    ):
        with pytest.raises(SystemExit) as left:
            main(command)
        assert not left.value.code
    for figure in ("bounce-y", "flip-0-1"):
        shutil.copytree(DATA / figure, folder / "few" / figure)
    (folder / "served").mkdir()
    (folder / "served" / "index.html").write_text("<p>a site</p>")
    return folder


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Give the address of a scheduler with a worker, whose keys Dask's configuration has: one for all commands."""
    import dask

    with workers("local:1", "cpu") as executor:
        client = executor._client  # type: ignore[union-attr]
        keys = client.security
        named = {"ca-file": keys.tls_ca_file, "client.cert": keys.tls_client_cert, "client.key": keys.tls_client_key}
        with dask.config.set({f"distributed.comm.tls.{name}": value for name, value in named.items()}):
            yield client.scheduler.address


@pytest.mark.parametrize("command", ONCE)
def test_every_command_runs(
    run: Run, desk: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest, command: str
) -> None:
    """What serves is stopped at once, what opens a viewer is kept from it."""
    opened: list[Path] = []

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(desk)  # where workers start, too: it is there as long as they are
    monkeypatch.setenv("XDG_DATA_HOME", str(desk / "data"))
    monkeypatch.setattr("gradscape.jobs.explore_page.Explorer.wait", lambda explorer: explorer.close())
    if command.split()[1] != "explore":  # which serves on another thread
        monkeypatch.setattr("http.server.ThreadingHTTPServer.serve_forever", stop)
    monkeypatch.setattr(view, "show_recording", lambda path, *, serve: opened.append(path))
    for name, value in (("REPETITION", 0.01), ("LARGEST", 0.01), ("RESAMPLES", 9)):
        monkeypatch.setattr(f"gradscape.studies.samples.{name}", value)
    if "taichi" in command.split() and find_spec("taichi") is None:
        pytest.skip("Taichi has no wheels past Python 3.12")
    words = [request.getfixturevalue("address") if word == "ADDRESS" else word for word in small(command)]
    if "--tolerance" in words:  # which needs a study
        run.ok("study", "fidelity", "bounce", *TENTH, "--points", "4", "--out", "studied", cwd=desk)
    run.ok(*words, cwd=desk)
    assert bool(opened) == ("view" in command)


@pytest.mark.drawn
@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_every_block_of_python_runs(
    desk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: int
) -> None:
    """As a script of its own does, but in this process: it has none of this module's names."""
    block = BLOCKS[number]
    monkeypatch.chdir(desk)
    assert sum(bool(line.strip()) for line in block.splitlines()) < 40
    exec(compile(block, "block", "exec"), {"__name__": "__main__"})
    if "throw.png" in block:
        assert 0 <= float(capsys.readouterr().out.split()[-1]) < 0.1  # the target can be hit
        assert (desk / "throw.png").read_bytes().startswith(b"\x89PNG")


def test_every_import_of_gradscape_in_a_page_finds_its_names() -> None:
    """Of blocks that no test runs, too."""
    found = {tuple(one) for one in re.findall(r"^ *from (gradscape[\w.]*) import ([\w, ]+)$", TEXT, flags=re.MULTILINE)}
    assert len(found) > 3
    lacks = {
        (module, name)
        for module, names in found
        for name in names.split(", ")
        if not hasattr(import_module(module), name.split()[0]) and find_spec(f"{module}.{name.split()[0]}") is None
    }
    assert not lacks


def test_the_two_commands_are_the_makefiles() -> None:
    recipes = (ROOT / "Makefile").read_text()
    said = re.search(r"make demo +# installs gradscape, then runs `(landscape [^`]*)`", README)
    assert said
    assert f"$(BIN)/{said[1]}" in recipes
    assert re.search(r"^test: setup-test", recipes, flags=re.MULTILINE)


def test_what_pip_is_told_to_install_is_there() -> None:
    said = [one.partition(" #")[0].strip() for one in re.findall(r"(?:pip|pipx) install '?([^'`\n]+)'?", TEXT)]
    assert len(said) >= 3
    extras = {name for one in said for name in re.findall(r"^\.\[(\w+)\]$", one)}
    assert extras == {"rl", "distributed"} <= set(PROJECT["optional-dependencies"])
    assert {one for one in said if "[" not in one} == {PROJECT["name"]}
    assert {one for said_ in re.findall(r"uvx --from (\w+ \w+)", TEXT) for one in said_.split()} == {
        PROJECT["name"], *PROJECT["scripts"]
    }  # fmt: skip


def test_the_example_package_registers_an_environment(tmp_path: Path) -> None:
    package = ROOT / "docs/example_package"
    entry = re.search(r'gradscape.environments"\]\n(.*?)\n\n', (package / "pyproject.toml").read_text(), re.DOTALL)
    assert entry
    assert entry[1] in TEXT
    info = tmp_path / "throw_env-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: throw-env\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[gradscape.environments]\n" + entry[1].replace('"', "") + "\n")
    command = [sys.executable, "-m", "gradscape", "slice", "throw", "--dims", "angle", "speed", "--resolution", "5"]
    path = {"PYTHONPATH": f"{tmp_path}:{package}", "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "25 ok" in done.stderr


def test_every_picture_and_file_that_a_page_names_is_there() -> None:
    missing = []
    for page in PAGES:
        for name in re.findall(r"\]\(([^)]+)\)", page.read_text()):
            if "://" in name or "generated/" in name:  # the latter are there when the documentation is built
                continue
            file, _, heading = name.partition("#")
            target = page.parent / file if file else page
            if not target.exists() or (heading and heading not in _headings(target)):
                missing.append((page.name, name))
    assert missing == []


def _headings(file: Path) -> set[str]:
    """Return the anchors that headings have on GitHub."""
    titles = re.findall(r"^#+ (.+)$", file.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
