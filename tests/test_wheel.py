"""What strangers install: sdist and wheel are built, and the wheel is tried in an empty environment far from here.

The environment borrows the packages of the one that runs the tests; with INSTALL_DEPENDENCIES=1 they are installed.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import pytest

from gradscape.envs.registry import EXTRAS

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parent.parent
NOT_SENT = {".git", ".venv*", "build", "dist", "out", "__pycache__", "node_modules", "generated"}
LARGEST = 10_000_000  # bytes of a wheel or an sdist
LOST = ("*.egg-info", ".*_cache", ".hypothesis")
TRIED = """
--version
envs
envs fluid
info
methods bo-leap
slice rastrigin --dims 0 1 --resolution 4 --out rastrigin
slice bounce --dims 0 1 --resolution 4 --fidelity draft --device cpu --out bounce
slice bounce --dims 0 1 --resolution 3 --device cpu --tolerance 5% --out tolerant
gallery compute --only bounce-y --part slices --resolution 8 --fidelity draft --device cpu
gallery list
gallery build
""".strip().splitlines()
DRIVER = """
import importlib, json, pkgutil, sys, traceback
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from gradscape.cli import main
said = {}
for line in json.load(sys.stdin):
    out = StringIO()
    sys.argv = ["landscape", *line.split()]
    try:
        with redirect_stdout(out), redirect_stderr(out):
            main(line.split())
    except SystemExit as left:
        said[line] = [left.code or 0, out.getvalue()]
    except BaseException:
        said[line] = ["raised", out.getvalue() + traceback.format_exc()]
import gradscape
names = [module.name for module in pkgutil.walk_packages(gradscape.__path__, "gradscape.")]
missing = {}
for name in names:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing[name] = error.name
print(json.dumps({"said": said, "home": gradscape.__path__[0], "names": names, "missing": missing}))
"""


def tree(folder: Path, *, data: bool = False) -> Path:
    """Copy what a clone holds, its links as links, without the figures' data unless asked."""

    def ignored(place: str, names: list[str]) -> set[str]:
        lost = shutil.ignore_patterns(*NOT_SENT, *LOST)(place, names)
        figures = set(names) - {"studies"} if place.endswith("gallery/data") and not data else set()
        return lost | figures

    shutil.copytree(ROOT, folder, symlinks=True, ignore=ignored)
    return folder


def ran(*command: object, cwd: Path, **how: object) -> str:
    """Run a program without what this process was told about where packages are, and return what it printed."""
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    env = clean | {"XDG_DATA_HOME": str(cwd / "data"), "COLUMNS": "80"}
    done = subprocess.run([*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, check=False, **how)  # type: ignore[call-overload]
    assert done.returncode == 0, done.stdout + done.stderr
    return str(done.stdout)


def packed(clone: Path, folder: Path) -> Path:
    """Build the sdist of a clone into a folder, and return it."""
    ran(sys.executable, "-c", f"from setuptools import build_meta; build_meta.build_sdist({str(folder)!r})", cwd=clone)
    (sdist,) = folder.glob("*.tar.gz")
    return sdist


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Build an sdist of a clone, and a wheel of nothing but the sdist."""
    folder = tmp_path_factory.mktemp("built")
    clone = tree(folder / "clone with a space")
    sdist = packed(clone, folder)
    how = ["--no-deps", "--no-build-isolation", "--no-index", "--no-cache-dir", "--quiet"]
    ran(sys.executable, "-m", "pip", "wheel", *how, "--wheel-dir", folder, sdist, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    return {"sdist": sdist, "wheel": wheel, "clone": clone}


@pytest.fixture(scope="module")
def python(built: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel into an empty environment and return its interpreter."""
    home = tmp_path_factory.mktemp("installed") / "env"
    ran(sys.executable, "-m", "venv", "--without-pip", home, cwd=home.parent)
    found = home / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", found, "install", "--quiet", "--disable-pip-version-check"]
    if os.environ.get("INSTALL_DEPENDENCIES"):
        pins = ROOT / "constraints.txt"
        (torch,) = (line for line in pins.read_text().splitlines() if line.startswith("torch=="))
        for wanted in (torch, built["wheel"]):  # torch by itself, so that it is the build that is asked for
            ran(*install, "--constraint", pins, wanted, cwd=home.parent)
    else:
        ran(*install, "--no-deps", "--no-index", built["wheel"], cwd=home.parent)
        site = Path(ran(found, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=home.parent).strip())
        (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return found


@dataclass(frozen=True)
class Tried:
    """What commands said in a folder, one after the other, and then which modules import in the same process.

    `changed`: files that the package has gained or lost meanwhile.
    """

    folder: Path
    said: dict[str, tuple[int | str, str]]
    home: str
    names: list[str]
    missing: dict[str, str]
    changed: list[Path]


@pytest.fixture(scope="module")
def tried(python: Path, tmp_path_factory: pytest.TempPathFactory) -> Tried:
    folder = tmp_path_factory.mktemp("tried")
    (site,) = (python.parent.parent / "lib").glob("python*/site-packages/gradscape")

    def files() -> set[Path]:
        return {file for file in site.rglob("*") if "__pycache__" not in file.parts}

    before = files()
    out = ran(python, "-c", DRIVER, cwd=folder, input=json.dumps(TRIED)).splitlines()[-1]
    return Tried(folder, **json.loads(out), changed=sorted(before ^ files()))


def names_of(archive: Path) -> set[str]:
    """Return the files of an sdist or a wheel, as paths in the package."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as opened:
            every = [Path(name) for name in opened.namelist()]
    else:
        with tarfile.open(archive) as opened:
            files = [one.name for one in opened.getmembers() if one.isfile() and "/src/" in one.name]
        every = [Path(*Path(name).parts[2:]) for name in files]
    return {str(Path(*path.parts[1:])) for path in every if path.parts[:1] == ("gradscape",)}


@pytest.mark.parametrize("kind", ["sdist", "wheel"])
def test_every_file_of_the_package_is_sent(built: dict[str, Path], kind: str) -> None:
    package = built["clone"] / "src" / "gradscape"
    wanted = {
        str((Path(place) / name).relative_to(package))
        for place, _, names in os.walk(package, followlinks=True)
        for name in names
    }
    measured = ("gallery/data/studies/",)
    pictures = {name for name in wanted if name.startswith(measured) and name.endswith(".png")}
    assert names_of(built[kind]) == wanted - pictures
    assert "cli.py" in wanted
    assert len(pictures) > 10


def test_what_is_sent_is_small_for_all_that_the_figures_weigh(built: dict[str, Path], tmp_path: Path) -> None:
    """The index, and whoever installs it, is spared the gallery's data; what `--tolerance` reads is sent."""
    clone = tree(tmp_path / "whole", data=True)
    data = [file for file in (clone / "gallery/data").rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in data) > LARGEST
    sdist = packed(clone, tmp_path)
    assert names_of(sdist) >= names_of(built["sdist"])
    assert not any(".zarr" in name for name in names_of(sdist))
    assert max(sdist.stat().st_size, built["wheel"].stat().st_size) < LARGEST


def test_every_module_imports_where_it_is_installed(built: dict[str, Path], python: Path, tried: Tried) -> None:
    """But for those that need a package of an extra, where the wheel is installed without."""
    assert Path(tried.home).is_relative_to(python.parent.parent)
    files = {name for name in names_of(built["wheel"]) if name.endswith(".py")}
    modules = {"gradscape." + name.removesuffix(".py").replace("/", ".").removesuffix(".__init__") for name in files}
    assert {*tried.names, "gradscape.__init__"} == modules
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = [re.split("[^a-z0-9-]", one)[0] for one in extras["rl"] + extras["distributed"]]
    optional = {one.replace("-", "_") for one in (*wanted, *chain(*EXTRAS.values()))}
    assert set(tried.missing.values()) <= optional


def test_the_command_works_there_and_leaves_its_results_where_one_stands(python: Path, tried: Tried) -> None:
    said, folder = tried.said, tried.folder
    assert ran(python.parent / "landscape", "--help", cwd=folder).startswith("Usage: landscape")
    assert {line: code for line, (code, _) in said.items()} == dict.fromkeys(TRIED, 0), said
    assert "the fastest of" in said[next(line for line in TRIED if "--tolerance" in line)][1]
    assert (folder / "rastrigin/landscape.png").exists()
    assert (folder / "out/gallery-data/bounce-y/slice.zarr.zip").exists()
    assert "figures in out/gallery-data" in said["gallery list"][1]
    assert (folder / "out/gallery/bounce-y/index.html").exists()
    assert tried.changed == []
