"""Every verb, with all that it starts, listens to this machine and to nobody else."""

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from pathlib import Path
from socket import AF_INET, AF_INET6
from typing import Any

import pytest

from gradscape.cli import main, verbs
from gradscape.jobs import workers as cluster
from gradscape.landscapes.draw.recordings import viewer

from .command import SMALL, leave_blank, options
from .processes import FORK
from .sockets import beyond_loopback, listening

pytestmark = pytest.mark.e2e

# Flags of what results are like, and not of what is started.
RESULTS = {"--json", "--force", "--no-gradients", "--deterministic", "--film", "--no-film", "--claims", "--all"}
RESULTS |= {"--chaotic"}
NO_WINDOW = "rerun's viewer could not open a window"
SERVED = "until Ctrl-C"  # what is said by all that serves


VERBS = verbs()


def verb_of(line: str) -> str:
    return next(verb for verb in VERBS if f"{line} ".startswith(f"{verb} "))


def lines(small: str) -> Iterator[str]:
    """Yield a verb's small command, on workers where it takes them, and then with each flag that may start more."""
    known = options(VERBS[verb_of(small)])
    yield small + (" --scheduler local:1" if "--scheduler" in known else "")
    yield from (f"{small} {name}" for name, is_flag in known.items() if is_flag and name not in RESULTS)


class Watched(io.StringIO):
    """Take what a verb says; where it says that it serves, look what is open and stop it."""

    def write(self, text: str) -> int:
        if SERVED in text:
            look()
            raise KeyboardInterrupt
        return super().write(text)


seen: set[str] = set()  # where the verb that runs has listened


def look() -> None:
    seen.update(listening())


def watch(event: str, arguments: tuple[Any, ...]) -> None:
    """Note what Python binds, and what is open whenever a page is asked for: by then its server is there."""
    if event == "socket.bind" and arguments[0].family in (AF_INET, AF_INET6):
        host, port = arguments[1][:2]
        seen.add(f"{'127.0.0.1' if host == 'localhost' else host or '0.0.0.0'} {port}")
    if event == "urllib.Request":
        look()


def windowless(*arguments: str, log: Any) -> "subprocess.Popen[bytes]":
    """Start rerun without a window, which needs a display, and end it as soon as it listens."""
    if "--serve-web" in arguments:
        return RERUN(*arguments, log=log)
    process = RERUN("--headless", *arguments, log=log)
    before = set(listening())
    while process.poll() is None and set(listening()) <= before:
        pass
    look()
    process.kill()
    return process


RERUN = viewer._rerun


def walk(folder: Path) -> None:
    """Run all verbs one after the other, with one cluster for all, and write down where each listened."""
    os.chdir(folder)
    os.environ |= {"DISPLAY": ":none", "XDG_DATA_HOME": str(folder)}
    patch = pytest.MonkeyPatch()
    leave_blank(patch.setattr)
    for name, value in (("REPETITION", 0.002), ("LARGEST", 0.002), ("RESAMPLES", 9)):
        patch.setattr(f"gradscape.studies.samples.{name}", value)
    patch.setattr(viewer, "_rerun", windowless)
    sys.addaudithook(watch)
    found = {}
    with cluster._local(1, "cpu") as shared:
        patch.setattr(cluster, "_local", lambda *_: nullcontext(shared))
        look()
        found["cluster"] = (0, sorted(seen), "")
        for line in (line for small in SMALL for line in lines(small)):
            seen.clear()
            said = Watched()
            sys.argv = ["landscape", *line.split()]
            with redirect_stdout(said), redirect_stderr(said):
                try:
                    main(line.split())
                except SystemExit as left:
                    look()
                    found[line] = (left.code, sorted(seen), said.getvalue())
    (folder / "found.json").write_text(json.dumps(found))


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, list[str], str]]:
    folder = tmp_path_factory.mktemp("sockets")
    process = FORK.Process(target=walk, args=(folder,))
    process.start()
    process.join()
    return json.loads((folder / "found.json").read_text())


def test_every_verb_is_walked(found: dict[str, tuple[int, list[str], str]]) -> None:
    assert {verb_of(small) for small in SMALL} == set(VERBS)
    failed = {line: said for line, (code, _, said) in found.items() if code and NO_WINDOW not in said}
    assert failed == {}


def test_no_verb_listens_beyond_loopback(found: dict[str, tuple[int, list[str], str]]) -> None:
    assert {line: beyond_loopback(where) for line, (_, where, _) in found.items() if beyond_loopback(where)} == {}


def test_the_scan_sees_servers(found: dict[str, tuple[int, list[str], str]]) -> None:
    """Dask's and Python's, and rerun's two, which is no Python."""
    most = {line: len(set(where) - set(found["cluster"][1])) for line, (_, where, _) in found.items()}
    assert len(found["cluster"][1]) >= 5
    assert most["gallery serve --out site --port 0"] >= 1
    assert min(most["view over/overlay.rrd --serve"], most["overlay cut run --out over --serve"]) >= 3
