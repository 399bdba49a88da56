"""A folder that one process fills is waited for by another, and goes with the process that holds it."""

import shutil
import threading
from pathlib import Path

import pytest

from gradscape.landscapes.identity import StoreError
from gradscape.landscapes.storage.files import check_free, holding


def test_a_second_one_says_that_it_waits_and_goes_on_then(tmp_path: Path) -> None:
    said, waiting, order = list[str](), threading.Event(), list[str]()

    def say(text: str) -> None:
        said.append(text)
        waiting.set()

    def second() -> None:
        with holding(tmp_path / "race", say) as waited:
            order.append(f"second, waited: {waited}")

    with holding(tmp_path / "race") as waited:
        assert not waited
        other = threading.Thread(target=second)
        other.start()
        waiting.wait()
        order.append("first")
    other.join()
    assert order == ["first", "second, waited: True"]
    assert said == [f"another process is filling {tmp_path / 'race'}; waiting for it"]


def test_a_folder_that_was_removed_meanwhile_is_made_again(tmp_path: Path) -> None:
    waiting, held = threading.Event(), list[bool]()

    def second() -> None:
        with holding(tmp_path / "race", lambda text: waiting.set()):
            held.append((tmp_path / "race").is_dir())
            with pytest.raises(StoreError, match="is being filled by another process"):
                check_free(tmp_path / "race")

    with holding(tmp_path / "race"):
        other = threading.Thread(target=second)
        other.start()
        waiting.wait()
        shutil.rmtree(tmp_path / "race")
    other.join()
    assert held == [True]


def test_an_error_lets_a_folder_go(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), holding(tmp_path):
        raise RuntimeError
    check_free(tmp_path)
    check_free(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
