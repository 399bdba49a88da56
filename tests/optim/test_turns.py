"""Threads take turns: one works, the others wait, and one that waits for something else lets them."""

import threading
import time

from gradscape.optim.turns import Turns, aside


def test_one_thread_works_at_a_time_and_one_that_waits_lets_the_others() -> None:
    turns, working, most, answered = Turns(), [0], [0], threading.Event()

    def work(first: bool) -> None:
        turns.take()
        for _ in range(200):
            working[0] += 1
            time.sleep(0)  # whoever may run now, does
            most[0] = max(most[0], working[0])
            working[0] -= 1
        with aside():
            if first:
                assert answered.wait(timeout=60)
        turns.give()
        answered.set()

    threads = [threading.Thread(target=work, args=(number == 0,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert answered.is_set()
    assert not any(thread.is_alive() for thread in threads)
    assert most[0] == 1


def test_a_thread_without_turns_is_aside_all_the_time() -> None:
    turns = Turns()
    with aside():
        turns.take()
    with aside():
        thread = threading.Thread(target=lambda: (turns.take(), turns.give()))
        thread.start()
        thread.join(timeout=60)
        assert not thread.is_alive()
    turns.give()


def test_what_a_thread_waits_for_is_counted_for_it_alone() -> None:
    turns, waited = Turns(), []
    turns.take()
    began = threading.Event()

    def wait() -> None:
        began.set()
        turns.take()
        waited.append(turns.waited)
        turns.give()

    thread = threading.Thread(target=wait)
    thread.start()
    began.wait(timeout=60)
    mine = turns.waited
    turns.give()
    thread.join(timeout=60)
    assert waited[0] > 0.0
    assert turns.waited == mine
