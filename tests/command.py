"""What tests of the command share: what it makes, what it printed and what it imports."""

import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from gradscape.cli import Verb, main

needs_taichi = pytest.mark.skipif(find_spec("taichi") is None, reason="Taichi has no wheels past Python 3.12")
NO_BROWSER = "there is no Chromium here: `apt-get install -y chromium` (or your system's) lets them run"
PATIENCE = 600_000  # milliseconds until a browser is given up, and no measure of anything

# A small command of every verb, one after the other: each finds what those before it have left.
SMALL = """
envs
info
slice bounce --dims 0 1 --resolution 4 --fidelity draft --device cpu --out cut
sweep bounce --dims 0 1 --over 2 --frames 2 --resolution 2 --fidelity draft --device cpu
methods
advise branin --device cpu
optimize bounce --method random --budget 4 --fidelity draft --device cpu --out run
race bounce --methods random --seeds 1 --budget 2 --fidelity draft --device cpu
league branin --methods random --seeds 1 --budget 2 --device cpu
overlay cut run --out over
surface cut run
compare cut bounce --fidelity draft --device cpu
replay bounce --fidelity draft --device cpu --no-film
export cut
view over/overlay.rrd
bounce --axis y --resolution 3 --fidelity draft --device cpu
plan slice bounce --dims 0 1 --resolution 2 --fidelity draft --device cpu
bench bounce --batch 2 --seconds 0 --fidelity draft --device cpu
check branin --power 20%
study fidelity cartpole --set horizon=0.02 --points 2 --settings precision --device cpu
study mixed cartpole --set horizon=0.02 --points 2 --chaotic --time-limit 0.01 --device cpu
study extremes bounce --set horizon=0.05 --points 4 --settings dt --precisions float64 --fidelity draft --device cpu
pairs bounce --samples 2 --fidelity draft --device cpu
report cut --points-per-axis 2 --device cpu
hessian branin --device cpu
remedy branin --starts 6 --budget 16 --remedies clip:9 --device cpu
census branin --slices 1 --resolution 6
card --scene control --resolution 3
gallery compute --only bounce-y --part slices --resolution 4 --fidelity draft --device cpu --data data
gallery list --data data
gallery build --data data --out site
gallery serve --out site --port 0
explore branin --device cpu --no-browser --port 0
""".strip().splitlines()


@dataclass(frozen=True)
class Said:
    returncode: int
    stdout: str
    stderr: str

    @property
    def json(self) -> Any:
        """What was printed as JSON."""
        return json.loads(self.stdout)


@dataclass(frozen=True)
class Run:
    """Run the command in this process: its words one by one or as one text, in the test's folder unless in another."""

    call: Callable[..., Said]

    def __call__(self, *words: str, cwd: Path | None = None, width: int = 160) -> Said:
        return self.call(*(words[0].split() if len(words) == 1 else words), cwd=cwd, width=width)

    def ok(self, *words: str, cwd: Path | None = None, width: int = 160) -> Said:
        """Run what must succeed."""
        done = self(*words, cwd=cwd, width=width)
        assert done.returncode == 0, done.stderr
        return done

    def json(self, *words: str, cwd: Path | None = None) -> Any:
        """Run what must succeed with --json, and return what it prints."""
        split = words[0].split() if len(words) == 1 else words
        return self.ok(*split, *(() if "--json" in split else ("--json",)), cwd=cwd).json

    def refuse(self, *words: str, said: str, cwd: Path | None = None) -> Said:
        """Run what must be refused with exit code 2 and these words, whose lines a terminal may have folded."""
        done = self(*words, cwd=cwd)
        assert done.returncode == 2, done
        assert said in " ".join(done.stderr.split())
        return done


def options(verb: Verb) -> dict[str, bool]:
    """Return the options of a verb, and whether each is a flag, which takes no value."""
    named = [one for one in verb.options if one.names[0].startswith("-")]
    return {name: one.type is bool for one in named for name in one.names}


def leave_blank(put: Callable[[object, str, Any], object]) -> None:
    """Let pictures and frames of films be blank, and not laid out: most of what a small job takes is drawing them.

    `put` is setattr, or what does the same for a while.
    """
    from matplotlib.figure import Figure

    from gradscape.landscapes.draw.figures import page

    save = Figure.savefig

    def leave(figure: Figure, where: Any, **options: Any) -> None:
        if options.get("format") == "rgba":  # a frame, whose size is known
            where.write(bytes(4 * math.prod(figure.canvas.get_width_height())))
        else:
            save(Figure(figsize=(0.1, 0.1)), where, **options)

    put(Figure, "savefig", leave)
    put(page, "settle", lambda picture: None)


def make(folder: Path, *commands: str) -> Path:
    """Run commands in this process and in a folder, their pictures blank: for tests of a module, which copy it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        leave_blank(patch.setattr)
        for command in commands:
            patch.setattr(sys, "argv", ["landscape", *command.split()])
            with pytest.raises(SystemExit) as left:
                main(command.split())
            assert not left.value.code, command
    return folder


def modules(*commands: list[str], missing: tuple[str, ...] = ()) -> set[str]:
    """Return what commands import, one after the other in a process where some packages are missing."""
    code = (
        f"import sys\nsys.modules.update(dict.fromkeys({missing}))\nfrom gradscape.cli import main\n"
        f"for words in {commands}:\n    try: main(words)\n    except SystemExit as left: assert not left.code, words\n"
        "print('MODULES', *(name for name in sys.modules if sys.modules[name]), file=sys.stderr)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(said.stderr.split("MODULES")[1].split())
