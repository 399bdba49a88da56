"""Whether a package is installed, and what installs one of our extras."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

EXTRAS = {"mjx": ("mujoco", "mujoco-mjx", "jax"), "newton": ("newton",)}  # of this package, and what each brings


def installed_version(package: str) -> str | None:
    """Return the version of a package, without importing it; None where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def is_installed(package: str) -> bool:
    """Say whether a package is installed, without importing it."""
    return installed_version(package) is not None


def install_line(extra: str) -> str:
    """Return the command that installs an extra of this package."""
    return f"pip install 'gradscape[{extra}]'"
