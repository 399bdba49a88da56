"""Peers are compared as the numbers say: their table, their gradients' errors, and what is refused by name."""

import argparse
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.peers import __main__ as driver
from benchmarks.peers.__main__ import HEAD, REQUIREMENTS, Pair, markdown, row
from benchmarks.peers.difftaichi import check as check_source
from benchmarks.peers.ours_chain import build as build_chain
from benchmarks.peers.ours_mpm import build as build_cube
from benchmarks.peers.protocol import gradient_error
from benchmarks.peers.scenes import Chain, Cube

CPU = argparse.Namespace(device="cpu")


def record(**changes):
    check = {"error": 1e-4, "step": 0.01}
    found = {"version": "peer 1.0", "precision": "float32", "material": "neo-Hookean", "grid": "64^3", "why": None}
    found |= {"particles": 8, "substeps": 10, "work": 8_000_000, "loss": -1.0, "forward": 2.0, "gradient": 8.0}
    found |= {"memory_forward": 10_000_000, "memory_gradient": 40_000_000, "check": check, "differs": ["It has walls."]}
    return found | changes


def test_a_gradient_that_is_right_is_found_to_be_and_half_of_it_is_off_by_half():
    at = np.array([0.3, -0.7, 1.1])
    assert gradient_error(lambda x: float(np.sin(x).sum()), np.cos(at), at).error < 1e-7
    assert gradient_error(lambda x: float((x**2).sum()), at, at).error == pytest.approx(0.5, rel=1e-6)
    assert not gradient_error(lambda x: float(x.sum()), np.full(3, np.nan), at).error < 1


def test_the_table_has_ratios_of_seconds_and_rates_of_work():
    pair = Pair("other", record(), record(forward=1.0, gradient=2.0, memory_forward=5_000_000))
    cells = dict(zip(range(len(HEAD)), row(pair), strict=True))
    assert [cells[k] for k in (2, 3, 4, 5, 6, 7)] == ["4", "1", "2 x", "4 x", "10 : 5", "40 : 40"]
    assert cells[8] == "1.0e-04 (step 0.01)"


def test_a_peer_without_gradient_says_why():
    other = record(gradient=None, check=None, memory_gradient=None, why="its kernels have no adjoints.")
    text = markdown([Pair("other", other, record())])
    assert "| none |" in text
    assert "No gradient: its kernels have no adjoints." in text


@pytest.mark.parametrize("error", [0.3, float("nan")])
def test_a_wrong_gradient_is_called_wrong(error):
    wrong = record(check={"error": error, "step": 0.1})
    assert "Its gradient is wrong" in markdown([Pair("other", wrong, record())])
    assert "wrong" not in markdown([Pair("other", record(), record())])


def test_a_peer_that_failed_is_in_the_table_with_its_error():
    text = markdown([Pair("other", {"failed": "ImportError: a | b"}, {})])
    assert "| `other` | ImportError: a / b |" in text
    assert all(line.count("|") == len(HEAD) + 1 for line in text.splitlines() if line.startswith("|"))


def test_a_peer_that_is_not_there_is_refused_by_name(capsys):
    with pytest.raises(SystemExit):
        driver.main(["taichi"])
    assert "no peer 'taichi'; there are genesis" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        driver.main(["--python", "genesis"])
    assert (
        "--python takes PEER=PATH of genesis, rewarped, difftaichi, newton, mjx; got 'genesis'"
        in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("print('half'); import sys; sys.exit('no such module')", "it ended with 1: no such module"),
        ("print('[]')", "its last line is no JSON object"),
        ("import time; time.sleep(60)", "it ran longer than 0.5 s"),
    ],
)
def test_a_peer_that_breaks_off_is_reported(tmp_path: Path, program, said):
    python = tmp_path / "python"
    (tmp_path / "program.py").write_text(program)
    script = shlex.join([sys.executable, str(tmp_path / "program.py")])
    python.write_text(f"#!/bin/sh\nexec {script}\n")  # a line of #! ends at the first space of a path
    python.chmod(0o755)
    assert driver.measure(python, "genesis_mpm", [], 0.5 if "sleep" in program else 60)["failed"] == said


def test_a_peer_is_asked_for_the_same_size_as_ours(monkeypatch):
    asked = SimpleNamespace(device="cpu", repeat=1, rounds=2, particles=27, substeps=4, limit=9.0)
    calls = []

    def measure(python, script, how, limit):
        calls.append((script, dict(one.split("=") for one in how)))
        return record()

    monkeypatch.setattr(driver, "measure", measure)
    driver.compare("difftaichi", Path("python"), asked, "file.py")
    assert [script for script, _ in calls] == ["difftaichi", "ours_mpm"] * 2
    assert calls[0][1].pop("--source") == "file.py"
    assert calls[0][1] == calls[1][1]


def test_every_peer_has_pinned_versions():
    for path in REQUIREMENTS.iterdir():
        lines = [line.split("#")[0].strip() for line in path.read_text().splitlines()]
        assert all("==" in line for line in lines if line), path.name
    assert {path.name.split(".")[0] for path in REQUIREMENTS.iterdir()} == set(driver.PEERS)


def test_another_file_than_the_pinned_one_is_refused(tmp_path: Path):
    path = tmp_path / "diffmpm3d.py"
    path.write_text("import taichi\n")
    with pytest.raises(ValueError, match="has the SHA-256"):
        check_source(path)


def test_sizes_that_make_no_scene_are_refused():
    with pytest.raises(ValueError, match="got 1001, take 1000 or 1331"):
        Cube(1001, 8)
    with pytest.raises(ValueError, match="multiple of 2 steps"):
        Chain(4, 7)


def test_what_a_scene_pulls_back_is_the_transpose_of_what_it_sets():
    cube = Cube(27, 4)
    rng = np.random.default_rng(3)
    parameters, adjoint = rng.standard_normal(12), rng.standard_normal((27, 3))
    assert (cube.velocities(parameters) * adjoint).sum() == pytest.approx(cube.pull_back(adjoint) @ parameters)
    chain = Chain(2, 4)
    parameters, adjoint = rng.standard_normal(12), rng.standard_normal((2, 2, 3))
    assert (chain.torques(parameters) * adjoint).sum() == pytest.approx(chain.pull_back(adjoint) @ parameters)


def test_our_cube_flies_freely_until_it_meets_the_wall():
    cube = Cube(64, 8)
    flight = -build_cube(cube, CPU).loss(cube.start) - cube.x[:, 0].mean()
    assert flight == pytest.approx(8 * cube.dt * cube.start[0], rel=1e-4)


@pytest.mark.parametrize(("build", "scene"), [(build_cube, Cube(64, 32)), (build_chain, Chain(3, 20))])
def test_the_gradient_of_our_side_is_the_slope(build, scene):
    ours = build(scene, CPU)
    assert gradient_error(ours.loss, ours.gradient(scene.start), scene.start).error < 2e-3
