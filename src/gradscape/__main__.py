"""Run the command `landscape`, as `python -m gradscape` too."""

import gc
from typing import Any

from gradscape import cli

IMPORTED = 1_000_000  # objects, more than a command's imports make: none of them is garbage
YOUNG = 100_000  # objects from then on; by default Python looks for garbage among every 700 that are new


def main() -> Any:
    """Run the command in a process of its own.

    Of what it imports nothing is garbage, and to look through half a million objects again and again takes a fifth of
    the time of importing them, and a second at the end, when the system takes all memory back anyway. Where memory is
    short garbage is collected by name.
    """
    gc.set_threshold(IMPORTED)
    gc.callbacks.append(_look_closer)
    try:
        return cli.main()
    finally:
        gc.freeze()


def _look_closer(_phase: str, _about: dict[str, int]) -> None:
    """Look for garbage more often once the first look begins."""
    if gc.get_threshold()[0] == IMPORTED:
        gc.set_threshold(YOUNG)


if __name__ == "__main__":
    main()
