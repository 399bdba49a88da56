"""Whether a package is installed, and what installs one of our extras."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

COMPUTES_LOSSES = False  # for `code`


def is_installed(package: str) -> bool:
    """Say whether a package is installed, without importing it."""
    try:
        version(package)
    except PackageNotFoundError:
        return False
    return True


def install_line(extra: str) -> str:
    """Return the command that installs an extra of this package."""
    return f"pip install 'gradscape[{extra}]'"
