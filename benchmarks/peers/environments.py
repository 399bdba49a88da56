"""Make an environment for each peer, from the pinned versions in `requirements/`, in a folder of the user's cache."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from platformdirs import user_cache_path

REQUIREMENTS = Path(__file__).parent / "requirements"


class InstallError(RuntimeError):
    """Say that what a peer needs could not be installed."""


def needed(name: str, device: str) -> list[tuple[Path, tuple[str, ...]]]:
    """Return the files of versions that a peer needs on a device, each with what pip is told about it."""
    files = [(REQUIREMENTS / f"{name}.txt", ())]
    if device == "cuda":
        files.append((REQUIREMENTS / f"{name}.cuda.txt", ()))
    files.append((REQUIREMENTS / f"{name}.alone.txt", ("--no-deps",)))
    return [(path, how) for path, how in files if path.is_file()]


def interpreter(name: str, device: str, tell: Callable[[str], None]) -> Path:
    """Return the interpreter of a peer's environment, which is made where these versions have none yet."""
    files = needed(name, device)
    if not files:
        raise InstallError(f"there are no requirements of {name} in {REQUIREMENTS}")
    digest = hashlib.sha256(b"".join(path.read_bytes() for path, _ in files) + sys.version.encode()).hexdigest()[:12]
    folder = user_cache_path("gradscape") / "peers" / f"{name}-{digest}"
    python, done = folder / "bin" / "python", folder / "installed"
    if not done.exists():
        tell(f"{name}: installing its environment into {folder}")
        install(folder, python, files)
        done.touch()
    return python


def install(folder: Path, python: Path, files: list[tuple[Path, tuple[str, ...]]]) -> None:
    """Make an environment and install files of versions into it. Raises InstallError with what pip said last."""
    commands = [[sys.executable, "-m", "venv", "--clear", str(folder)]]
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    commands += [[*pip, *how, "-r", str(path)] for path, how in files]
    for command in commands:
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        if ended.returncode:
            said = [line for line in ended.stderr.splitlines() if line.strip() and "WARNING" not in line]
            raise InstallError(f"could not be installed: {said[-1] if said else f'pip ended with {ended.returncode}'}")
