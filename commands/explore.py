"""The explorer, on the terminal: its address, until Ctrl-C."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .terminal import Console

if TYPE_CHECKING:
    from ..jobs.explore_page import Explorer


def show(found: Explorer, console: Console) -> None:
    """Print where the page is, and serve it until Ctrl-C."""
    try:
        console.print(f"{found.exploration.env.name} is at {found.address} until Ctrl-C", soft_wrap=True)
        found.wait()
    except KeyboardInterrupt:
        found.close()
