"""Words for functions whose character is known: right wherever they are given, and the same at all resolutions."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.words import FUNCTIONS, Row, judge

from gradscape.landscapes.convert import from_json, to_json
from gradscape.landscapes.measures.verdict import WORDS, QuotedWord, Verdict

BY_NAME = {one.name: one for one in FUNCTIONS}
QUICK = (
    "double well", "Rastrigin", "ridge", "plateau", "Weierstrass, 0.5", "step through half of the range",
    "noise of 5 %", "flat to rounding", "gradients opposite", "gradients loose",
)  # fmt: skip


@pytest.mark.parametrize("name", QUICK)
def test_no_word_is_wrong_and_none_changes_with_the_samples_nor_by_samples_alone(name: str) -> None:
    row = Row(BY_NAME[name], {n: judge(BY_NAME[name], n) for n in (16, 96)})
    assert (row.wrong, row.changed, row.missing) == ([], [], [])
    alone = Row(BY_NAME[name], {n: judge(BY_NAME[name], n, samples_only=True) for n in (16, 48)})
    assert (alone.wrong, alone.changed) == ([], [])


def test_a_row_sees_words_that_are_wrong_change_or_are_missing() -> None:
    bowl = judge(BY_NAME["bowl"], 16)
    wells = judge(BY_NAME["double well"], 16)
    row = Row(BY_NAME["bowl"], {16: bowl, 96: wells})
    assert row.wrong == [(96, "smooth with local minima")]
    assert set(row.changed) == {"very smooth", "smooth with local minima"}
    assert row.missing == [(96, "very smooth")]
    unsaid = set(WORDS) - set().union(*(one.must for one in FUNCTIONS))
    assert unsaid == {"gradients missing"}  # which tests/landscapes/measures/test_following.py has


def test_a_verdict_is_read_as_it_was_written_and_held_against_the_words_of_others() -> None:
    found = judge(BY_NAME["fault of 10 %"], 24)
    assert from_json(Verdict, to_json(found)) == found
    assert list(found.words) == [word for word in WORDS if word in found.words]
    assert found.compare_words(("discontinuous", "rugged")) == (
        QuotedWord("discontinuous", True),
        QuotedWord("rugged", False),
    )


def test_what_limits_the_words_is_always_said() -> None:
    found = judge(BY_NAME["noise of 1 %"], 24)
    jumps, noise, failed, numerics = found.lines
    assert jumps.startswith("jumps: none of ")
    assert noise.startswith("95 % of repeats agree within 2.")
    assert (failed, numerics) == ("a loss at every sample", "numerical floor not measured")
    alone = judge(BY_NAME["bowl"], 24, samples_only=True)
    assert alone.open == ("jumps not searched",)
    unknown = replace(alone, deviation=None)
    assert unknown.lines[0] == "noise not measured"
    some = judge(BY_NAME["failed in a fifth"], 24)
    assert some.lines[2] == f"no loss at {some.failed / some.samples:.1%} of the samples"


def test_flat_and_failed_slices_have_no_other_word() -> None:
    for name, word in (("flat", "flat"), ("failed in two thirds", "mostly failed")):
        found = judge(BY_NAME[name], 24)
        assert (found.words, found.open) == ((word,), ())
    assert judge(BY_NAME["flat"], 24).reasons["flat"] == "all losses are equal"
    assert np.isnan(judge(BY_NAME["flat"], 24).surface.minima.value)
