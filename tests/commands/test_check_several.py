"""`landscape check A B FILE.py:*`: several environments in one command, in processes or not, and the XML of JUnit."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

import gradscape as gs
from gradscape.envs.registry import names_in_file

from ..command import Run

FILE = '''
import torch
import gradscape as gs

SPACE = gs.ParameterSpace({"a": (0, 1), "b": (0, 1)})
first = second = gs.from_torch(lambda x: (x**2).sum(1), SPACE)
twice = gs.from_numpy(lambda x: ((x**2).sum(1), 4 * x), SPACE, name="twice")
_hidden = gs.from_torch(lambda x: x.sum(1), SPACE)

def helper(x):
    return x

class Never:
    """An objective that raises, whose message steers terminals."""
    space = SPACE

    def evaluate(self, x, *, grad=True):
        raise RuntimeError("\\x1b[31mno")
'''
ALL = "check branin several.py:* --power 20% --device cpu"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("several")
    (path / "several.py").write_text(FILE)
    return path


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    return folder


def test_every_simulator_of_a_file_is_named_once(here: Path) -> None:
    assert names_in_file("several.py:*") == ["several.py:first", "several.py:twice", "several.py:Never"]
    assert names_in_file("bounce") == ["bounce"]
    assert names_in_file("several.py:twice") == ["several.py:twice"]
    (here / "empty.py").write_text("x = 1\n")
    with pytest.raises(ValueError, match=r"empty.py has no simulator"):
        names_in_file("empty.py:*")
    with pytest.raises(ValueError, match=r"there is no file elsewhere.py"):
        names_in_file("elsewhere.py:*")


def test_each_has_a_line_and_a_verdict_and_one_that_fails_makes_the_exit_code_1(here: Path, run: Run) -> None:
    done = run(*ALL.split(), cwd=here)
    assert done.returncode == 1
    lines = done.stdout.splitlines()
    assert [line.split()[:2] for line in lines[:-1]] == [
        ["branin", "passes:"],
        ["first", "passes:"],
        ["twice", "fails:"],
        ["several.py:Never", "cannot"],
    ]
    assert "2 times the slope" in lines[2]
    assert r"\x1b[31mno" in lines[3]
    assert lines[-1] == "2 of 4 pass"


@pytest.mark.e2e
def test_processes_find_the_same_and_write_a_case_for_each_finding(here: Path, run: Run) -> None:
    alone = run(*ALL.split(), "--json", cwd=here)
    spread = run(*ALL.split(), "--json", "--jobs", "2", "--junit", "found/junit.xml", cwd=here)
    assert alone.returncode == spread.returncode == 1
    reports = [[report | {"command": ""} for report in done.json["reports"]] for done in (alone, spread)]
    outcomes = [[(one["env"], [check["outcome"] for check in one["checks"]]) for one in found] for found in reports]
    assert outcomes[0] == outcomes[1]
    assert spread.json["failed"].keys() == {"several.py:Never"}
    assert spread.json["passed"] is False
    suites = ElementTree.parse(here / "found/junit.xml").getroot()
    assert [suite.get("name") for suite in suites] == ["branin", "first", "twice", "several.py:Never"]
    for suite, report in zip(suites, reports[1], strict=False):
        assert [case.get("name") for case in suite] == [check["check"] for check in report["checks"]]
        assert int(suite.get("tests", 0)) == len(suite)
        assert int(suite.get("failures", 0)) == len(suite.findall("testcase/failure"))
        assert int(suite.get("skipped", 0)) == len(suite.findall("testcase/skipped"))
    failure = suites[2].find("testcase[@name='gradient']/failure")
    assert failure is not None
    assert "wrong at" in str(failure.get("message"))
    assert "Try: Look for the factor 2" in str(failure.text)
    error = suites[3].find("testcase/error")
    assert error is not None
    assert r"\x1b[31mno" in str(error.get("message"))


def test_one_environment_is_shown_as_ever_and_may_write_the_xml_too(here: Path, run: Run) -> None:
    done = run.ok("check branin --power 20% --junit one.xml", cwd=here)
    assert done.stdout.splitlines()[-1].startswith("passes: ")
    (suite,) = ElementTree.parse(here / "one.xml").getroot()
    assert (suite.get("name"), suite.get("failures")) == ("branin", "0")


def test_what_no_scene_has_is_refused_before_any_is_checked(here: Path, run: Run) -> None:
    run.refuse("check branin nothing --power 20%", said="nothing")
    run.refuse("check branin --jobs 0", said="jobs")


def test_a_name_that_a_file_does_not_have_is_said_in_its_line(here: Path, run: Run) -> None:
    done = run("check branin several.py:nothing --power 20%", cwd=here)
    assert done.returncode == 1
    assert "has no nothing" in done.stdout
    assert "1 of 2 pass" in done.stdout


def test_all_are_planned(here: Path, run: Run) -> None:
    (here / "two.py").write_text(FILE.split("class Never")[0])
    plan = run.ok("plan check two.py:* --power 20%", cwd=here).stdout
    one = run.ok("plan check two.py:first --power 20%", cwd=here).stdout
    assert plan != one


def test_from_python_several_give_one_record(here: Path) -> None:
    space = gs.ParameterSpace({"a": (0, 1)})
    good = gs.from_torch(lambda x: x[:, 0] ** 2, space, name="good")
    found = gs.check(good, "branin", power=0.2)
    assert [one.env for one in found.reports] == ["good", "branin"]
    assert found.passed
    assert found.failed == {}
    assert list(found.table()["passed"]) == [True, True]
    assert "good" in found._repr_html_()
