"""docs/measures.md has a row for every scene, with what the kept census says of its slices."""

from pathlib import Path

from benchmarks import censuses
from benchmarks.censuses import HEAD, NAME, PAGE, README, SHORT, SHORT_HEAD, Shares, rows, short_rows
from benchmarks.pages import DATA, MISSING, UNMEASURED, written

from gradscape.envs.registry import entries, environment_class
from gradscape.jobs.report_tables import markdown
from gradscape.landscapes.storage.records import read_json, write_record


def test_the_pages_hold_the_censuses() -> None:
    found = censuses.censuses()
    for page, head, lines in ((PAGE, HEAD, rows(found)), (README, SHORT_HEAD, short_rows(found))):
        assert written(page, NAME) == markdown(head, list(lines)), "`python -m benchmarks.censuses` writes the page"


def test_shares_of_a_column_count_no_slice_twice() -> None:
    for path in sorted((DATA / "census").glob("*.json")):
        for words in SHORT.values():
            assert all(len(set(words) & set(one["words"])) < 2 for one in read_json(path)["slices"])


def test_every_scene_of_ours_has_a_row() -> None:
    ours = {name for name, entry in entries().items() if not entry.extra}
    scenes = {name for name in ours if len(environment_class(name).fidelities) > 1}
    assert {line[0].strip("`") for line in rows(censuses.censuses())} == scenes


def test_a_scene_that_changed_or_was_never_measured_is_said_to_be_so(tmp_path: Path) -> None:
    record = read_json(DATA / "census" / "bounce-cpu.json")
    assert isinstance(censuses.censuses()["bounce"], Shares)
    record["identity"]["model_version"] = 0
    (tmp_path / "census").mkdir()
    write_record(tmp_path / "census" / "bounce-cpu.json", record)
    found = censuses.censuses(tmp_path)
    assert (found["bounce"], found["cartpole"]) == (UNMEASURED, MISSING)
    assert dict((line[0], line[3]) for line in rows(found))["`bounce`"] == UNMEASURED


def test_slices_along_which_losses_hardly_move_are_counted() -> None:
    record = read_json(DATA / "census" / "bounce-cpu.json")
    whole = Shares.of_record(record)
    ends = [end for one in record["slices"] for end in one["range"]]
    low, step = min(ends), 0.009 * (max(ends) - min(ends))
    kept = record["slices"][:10]
    for one in kept[:3]:
        one["range"] = [low, low + step]
    kept[9]["range"] = [low, max(ends)]
    kept[8]["range"] = [None, None]
    faint = Shares.of_record(record | {"slices": kept}).faint
    assert faint == 0.3 + sum(high - low < step / 0.9 for low, high in (one["range"] for one in kept[3:8])) / 10
    assert 0 <= whole.faint < 1
