"""Whatever is typed ends with a message: generated command lines of every verb, among results of all kinds.

A line is a valid one with one to three words lost, put in or replaced by hostile ones. Each runs in a process of its
own within limits of time and memory, and may change nothing beyond its folder. Ctrl-C comes with the first episode,
page or request, so that what is valid is stopped and not computed.
"""

import errno
import os
import random
import re
import resource
import shlex
import shutil
import signal
import sys
from functools import cache, partial
from http.server import ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from gradscape.cli import verbs
from gradscape.envs.base import Environment
from gradscape.gallery.site import build
from gradscape.jobs.explore_page import Explorer

from ..command import options
from ..faults import damage
from ..kinds import KINDS, MADE, copy, files, whole
from ..processes import Ended, alone, landscape

VALID = """
envs branin
info
methods cma-es
bounce --axis y --resolution 3 --window 0:1 --fidelity draft
bench branin --batch 2 --seconds 0
check branin --power 20%
plan bounce --dims 0 1 --resolution 3 --workers 2 --over horizon --frames 2
replay bounce --params point.json --no-film
race branin --methods random,cma-es --budget 5 --seeds 2 --workers 2 --option cma-es.sigma=0.2
gallery list --json --data gallery
gallery serve --out site --port 0
explore branin --no-browser --port 0
""".strip().splitlines()
NUMBERS = ("0", "-1", "1", "2", "7", "1e9", "1e308", "-1e308", "1e400", "nan", "inf", "-inf", "0x10", "1_000", "\u0663")
NUMBERS += ("100000", "2147483648", "9223372036854775808", "9" * 400, "1.5", "5e-324", "1e-300", "-0.0", "")
WORDS = (
    "",
    " ",
    "-",
    "--",
    "=",
    "=1",
    "a=",
    "a,b",
    ",",
    ":",
    "0:1",
    "1:0",
    "nan:1",
    "0:inf",
    "5%",
    "nan%",
    "[/b]",
    "[red]x",
)
WORDS += ("{}", "%s", "%00", "\0", "\udcff", "\u00e4 b", "x" * 5000, "d/" * 2000, "\n", "*", "..", "/", "~", "$HOME")
WORDS += (
    "center",
    "random:0",
    "random:-1",
    "random:" + "9" * 30,
    "example:aim",
    "example:[/b]",
    "best:run",
    "best:race",
)
WORDS += (
    "horizon",
    "smoothing",
    "pca",
    "x0",
    "draft",
    "reference",
    "cpu",
    "cuda",
    "taichi",
    "parquet",
    "local:0",
    "local:x",
)
WORDS += (
    "dim=3",
    "name=x",
    "self=1",
    "horizon=nan",
    "seed=-1",
    "initial=1e9",
    "branin",
    "bounce",
    "fluid",
    "sac",
    "bo",
    "own.py:A",
)
FOLDERS = ("slice", "run", "race", "gallery")  # kinds of which whole and damaged results are there
RAW = re.compile(  # errors of others, which say nothing of what is to be done
    r"landscape: (None$|Expecting |Extra data|invalid literal|could not convert|math domain|\[Errno|embedded null|"
    r"'utf-8'|not enough values|too many values|list index|cannot reshape|.*object has no attribute|\d+$|'\w*'$)"
)
WARNING = re.compile(r"^\S+\.py:\d+: \w*Warning: ", re.MULTILINE)
CPU_SECONDS, CLOCK_SECONDS, MEMORY = 60, 300, int(4e9)  # of a process: before Ctrl-C, and bytes beside what it loads


@cache
def desk() -> Path:
    """Return a folder with results, whole and damaged, links that lead astray, and somebody's work."""
    folder, chance = copy(whole("line")), random.Random(0)
    for kind in FOLDERS:
        for name in (kind, f"torn-{kind}"):
            shutil.copytree(whole(kind) / MADE, folder / name, symlinks=True)
        for file in chance.sample(files(folder / f"torn-{kind}"), 2):
            damage(chance, file)
    for odd in (b"\xff\xfe", b"[b]", "ä b".encode(), b"-x"):
        (folder / os.fsdecode(odd)).symlink_to("slice")
    for name, place in (("loop", "loop"), ("away", "/"), ("gone", "nowhere")):
        (folder / name).symlink_to(place)
    (folder / "point.json").write_text("[1.0, 2.0, 0.5]")
    (folder / "bytes.json").write_bytes(bytes(range(256)))
    (folder / "thesis").mkdir()
    (folder / "thesis/chapter.tex").write_text("years of work")
    return folder


def lines(verb: str) -> Any:
    """Return the strategy of a verb's command lines."""
    valid = [line.split() for line in (*VALID, *(one for kind in KINDS.values() for one in (kind.make, *kind.reads)))]
    first = len(verb.split())
    known = options(verbs()[verb]) | {"--help": True, "--none": True}
    places = sorted(path.name for path in desk().iterdir() if path.name not in ("home", "tmp", "thesis"))
    values = st.sampled_from([*NUMBERS, *WORDS, *places])
    put = st.sampled_from(sorted(known)).flatmap(
        lambda name: st.just([name]) if known[name] else values.map(lambda value: [name, value])
    )
    edits = st.tuples(st.integers(first, 12), st.integers(0, 1), put | values.map(lambda value: [value]) | st.just([]))

    def edited(drawn: tuple[list[str], list[tuple[int, int, list[str]]]]) -> list[str]:
        line = list(drawn[0])
        for at, lost, new in drawn[1]:
            line[at : at + lost] = new
        return line

    return st.tuples(
        st.sampled_from([line for line in valid if line[:first] == verb.split()]),
        st.lists(edits, min_size=1, max_size=3),
    ).map(edited)


def confined(line: list[str]) -> None:
    """Run a command line within limits, stopped with its first episode, page or request."""

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGXCPU, stop)
    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, CLOCK_SECONDS)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 15))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, 2 * (pages * resource.getpagesize() + MEMORY,))
    here = os.path.realpath(".")
    os.environ |= {"XDG_DATA_HOME": f"{here}/home", "TMPDIR": f"{here}/tmp", "COLUMNS": "160"}
    allowed = tuple(f"{place}{os.sep}" for place in (here, Path.home() / ".cache", "/dev", "/proc", "/sys"))

    def keep_within(event: str, given: tuple[Any, ...]) -> None:
        writes = os.O_CREAT | os.O_WRONLY | os.O_RDWR | os.O_TRUNC
        changes = event in ("os.mkdir", "os.remove", "os.rmdir", "os.rename") or (event == "open" and given[2] & writes)
        if changes and isinstance(given[0], str | bytes | os.PathLike):
            folder, name = os.path.split(os.fsdecode(given[0]))
            if not os.path.join(os.path.realpath(folder or "."), name).startswith(allowed):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), name)

    sys.addaudithook(keep_within)
    stopped = [(Environment, "evaluate"), (build, "build_site"), (ThreadingHTTPServer, "serve_forever")]
    if line[:1] == ["explore"]:  # which samples and serves on threads of its own
        stopped = [(Explorer, "wait")]
    for place, name in stopped:
        setattr(place, name, stop)
    landscape(*line)


def fault(ended: Ended, folder: Path) -> str:
    """Say what is wrong with how a command ended; empty if nothing is."""
    said = ended.stdout + ended.stderr
    if ended.returncode not in (0, 1, 2, 130):
        return f"exit code {ended.returncode}"
    if "Traceback (most recent call last)" in said:
        return "traceback"
    if re.search(r"MemoryError|bad_alloc|[Uu]nable to allocate|[Cc]annot allocate memory", said):
        return "memory"
    if ended.returncode and not ended.stderr.strip():
        return "silent"
    if ended.returncode in (1, 2) and RAW.search(ended.stderr):
        return "raw error"
    if ended.returncode == 2 and not re.fullmatch(r"landscape: [^\n]*\n", ended.stderr):
        return "not one line"
    if WARNING.search(ended.stderr):
        return "warning"
    return "" if (folder / "thesis/chapter.tex").exists() else "removed what is not its own"


@pytest.mark.nightly
@pytest.mark.parametrize("verb", verbs())
def test_whatever_is_typed_ends_with_a_message(verb: str) -> None:
    @settings(max_examples=25, phases=[Phase.generate], database=None)
    @given(lines(verb))
    def ends(line: list[str]) -> None:
        folder = copy(desk())
        ended = alone(partial(confined, line), folder)
        wrong = fault(ended, folder)
        assert not wrong, f"{wrong}: landscape {shlex.join(line)[:500]}\n{ended.stderr[-2000:]}"
        shutil.rmtree(folder)

    ends()


def test_every_verb_has_a_valid_line() -> None:
    lines = [*VALID, *(one for kind in KINDS.values() for one in (kind.make, *kind.reads))]
    assert [
        verb for verb in verbs() if not any(line.split()[: len(verb.split())] == verb.split() for line in lines)
    ] == []
