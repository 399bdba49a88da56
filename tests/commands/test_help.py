"""What every verb says of itself: a sentence, an example that names it, and a word on each argument and option."""

from __future__ import annotations

import re

import pytest

from gradscape.cli import GROUPS, main, verbs

VERBS = verbs()


def test_a_verb_has_a_sentence_and_an_example() -> None:
    for name, verb in VERBS.items():
        text = verb.help()
        first = text.split("\n\n")[0]
        assert re.match(r"[A-Z].*\.$", first), name
        assert len(first.split()) <= 25, name
        assert f"Example: landscape {name}" in text


def test_help_lists_every_verb_in_four_groups_with_its_whole_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    places = [text.index(f"─ {heading} ─") for heading in GROUPS]
    assert places == sorted(places)
    for name, verb in VERBS.items():
        if not name.startswith("gallery"):
            assert f"│ {name} {verb.help().split(chr(10))[0]}" in re.sub(r" +", " ", text), name


def test_every_argument_and_option_is_explained_in_sentences() -> None:
    said = {(name, one.names[0]): one.help for name, verb in VERBS.items() for one in verb.options}
    assert {one: text for one, text in said.items() if not re.match(r"[A-Z][^;]*(;[^;]*)?\.$", text, re.DOTALL)} == {}


@pytest.mark.parametrize(
    ("words", "today"),
    [
        ("tradeoff bounce", "landscape study fidelity"),
        ("extremes bounce", "landscape study extremes"),
        ("slice branin --extent 0.5", "--window"),
        ("slice branin --print=85", "--figure-width-mm"),
        ("bench branin --against taichi", "--second-engine"),
        ("race branin --report", "--claims"),
        ("plan fluid --dims 6 8", "landscape plan slice fluid"),
    ],
)
def test_an_earlier_spelling_ends_with_todays(words: str, today: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(words.split())
    assert left.value.code == 2
    assert today in capsys.readouterr().err
