"""The package's links, and constraints and reasons of its dependencies; what is sent is tried by test_wheel.py."""

import re
import tomllib
from importlib.metadata import distributions
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_linked_folder_is_the_one_at_the_root() -> None:
    links = {link.name: link.resolve() for link in (ROOT / "src/gradscape").iterdir() if link.is_symlink()}
    folders = ("landscapes", "envs", "optim", "studies", "gallery", "jobs", "api", "commands", "cli.py")
    assert links == {name: ROOT / name for name in folders}


def test_constraints_are_plain_and_cover_every_dependency() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9_.]+", line) for line in lines)
    tested = {line.split("==")[0].lower().replace("_", "-") for line in lines}
    extras = PROJECT["project"]["optional-dependencies"].values()
    wanted = [*PROJECT["project"]["dependencies"], *(name for extra in extras for name in extra)]
    assert {re.split(r"[<>=;\[ ]", name)[0].lower() for name in wanted} <= {*tested, "gradscape"}  # its own extras


@pytest.mark.parametrize("python", ["3.11.0", "3.12.0", "3.13.0", "3.14.0"])
def test_constraints_hold_for_the_first_patch_of_every_python(python: str) -> None:
    """Debian 12 has 3.11.2, for which pip would look for versions without an end, since a constraint allows none."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines)}
    tried = [
        one
        for one in distributions()
        if pinned.get(canonicalize_name(one.metadata["Name"])) == one.version.partition("+")[0]
    ]
    assert len(tried) > 50
    wanted = {one.metadata["Name"]: one.metadata.get("Requires-Python") for one in tried}
    refused = {name: said for name, said in wanted.items() if said}
    assert {name: said for name, said in refused.items() if not SpecifierSet(said).contains(python)} == {}


def test_every_dependency_states_its_reason() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    lines = [line for line in text.splitlines() if re.match(r'\s+"[a-z-]+>=', line)]
    assert len(lines) >= 15
    assert all("#" in line for line in lines)


def test_classifiers_are_of_the_versions_and_the_extras_that_are_tested() -> None:
    project = PROJECT["project"]
    low, high = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", project["requires-python"]).groups()  # type: ignore[union-attr]
    said = {name.rpartition(" :: 3.")[2] for name in project["classifiers"] if " :: 3." in name}
    assert said == {str(minor) for minor in range(int(low), int(high))}
    assert len(set(project["classifiers"])) == len(project["classifiers"])
    assert "Typing :: Typed" in project["classifiers"]
    assert (ROOT / "src/gradscape/py.typed").exists()
