"""Results of every kind under full disks, ends of their process and damaged files, in any order.

What is read is right, or the command ends in a line that names what is wrong; what was interrupted ends in the numbers
of an undisturbed run.
"""

import gc
import random
import re
import shutil
from pathlib import Path
from typing import ClassVar

import pytest
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule, run_state_machine_as_test

from .command import Said
from .faults import FAULTS, Killed, damage
from .kinds import KINDS, before, copy, files, missing, numbers, printed, say, undisturbed, wrong

pytestmark = [pytest.mark.e2e, pytest.mark.nightly]  # cases are drawn at random, and take seconds each

FULL = re.compile(r"no space|no room|disk is full|of disk, and .* free here", re.IGNORECASE)
ADVICE = re.compile(r"make room|same command|run it again")
EXAMPLES = settings(
    max_examples=5, stateful_step_count=6, phases=[Phase.generate], report_multiple_bugs=False, database=None
)  # each takes seconds, so that none is made smaller
ADMITS = re.compile(r"damaged|missing|not sampled|left out|failed|not reported")  # that not all is there


class Disturbed(RuleBasedStateMachine):
    """The folder of a result, from empty to whole, and what befalls it."""

    kind: ClassVar[str]

    def __init__(self) -> None:
        super().__init__()
        self.folder, self.done = copy(before(self.kind)), ""

    @property
    def result(self) -> Path:
        """Where the result is."""
        return self.folder / KINDS[self.kind].where

    @rule(changes=st.integers(0, 80), kills=st.booleans())
    def interrupt(self, changes: int, kills: bool) -> None:
        """Begin or continue, until the process is killed or the disk is full."""
        try:
            with FAULTS.after(changes, self.result, kills=kills):
                done = say(KINDS[self.kind].make, self.folder)
        except Killed:
            gc.collect()  # a process that ends gives up its locks
            return
        if FAULTS.met and not kills:
            assert done.returncode, f"met a full disk and ended as if nothing was: {done.stderr}"
        if FAULTS.met and done.returncode == 1:
            assert FULL.search(done.stderr), done.stderr
            assert ADVICE.search(done.stderr), done.stderr
        else:
            self.judge(KINDS[self.kind].make, done, self.folder, complete=not FAULTS.met)

    @precondition(lambda self: self.result.is_dir() and files(self.result))
    @rule(seed=st.integers(0, 2**32))
    def damage(self, seed: int) -> None:
        """Damage one file."""
        chance = random.Random(seed)
        file = chance.choice(files(self.result))
        damage(chance, file)

    @precondition(lambda self: self.result.exists() and KINDS[self.kind].reads)
    @rule(number=st.integers(0, 9))
    def read(self, number: int) -> None:
        """Run a verb that reads the result, on a copy: it may go on with it, too."""
        reads = KINDS[self.kind].reads
        folder = copy(self.folder)
        self.judge(reads[number % len(reads)], say(reads[number % len(reads)], folder), folder, complete=False)
        shutil.rmtree(folder)

    @rule()
    def finish(self) -> None:
        """Let the command end; where it refuses what is there, `--force` or an empty folder makes the whole result."""
        command = KINDS[self.kind].make
        done = say(command, self.folder)
        self.judge(command, done, self.folder, complete=True)
        if done.returncode:
            if "--force" not in done.stderr:
                shutil.rmtree(self.result)
            forced = f"{command} --force" if "--force" in done.stderr else command
            done = say(forced, self.folder)
            assert done.returncode == 0, done.stderr
            self.judge(forced, done, self.folder, complete=True)

    def judge(self, command: str, done: Said, folder: Path, *, complete: bool) -> None:
        """Hold what a command left and said against the undisturbed."""
        if done.returncode:
            last = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ""
            assert done.returncode in (1, 2), done
            assert KINDS[self.kind].where in last or "`landscape " in last, f"{command}: {done.stderr}"
            return
        right, said = undisturbed(self.kind, command.removesuffix(" --force"))
        found, admits = numbers(folder), ADMITS.search(done.stderr)
        assert admits or not wrong(found, right), f"{command}: {wrong(found, right)}\n{done.stderr}"
        assert admits or not complete or not missing(found, right), f"{missing(found, right)}\n{done.stderr}"
        assert admits or not complete or printed(done.stdout) == said, f"{command}: {done.stdout}\n{said}"

    def teardown(self) -> None:
        """Finish, whatever befell it."""
        if self.folder.exists():
            self.finish()
            shutil.rmtree(self.folder)


@pytest.mark.parametrize("kind", KINDS)
def test_whatever_befalls_a_result_it_is_right_or_names_what_is_wrong(kind: str) -> None:
    machine = type(f"Disturbed {kind}", (Disturbed,), {"kind": kind})
    run_state_machine_as_test(machine, settings=EXAMPLES)  # type: ignore[no-untyped-call]
