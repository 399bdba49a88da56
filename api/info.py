"""The verb `info`: versions and devices."""

from __future__ import annotations

from dataclasses import dataclass

from .call import verb


@dataclass(frozen=True)
class Info:
    """Record the installed versions by package, and the devices of this machine."""

    gradscape: str
    python: str
    packages: dict[str, str]
    cores: int
    gpus: tuple[str, ...]


@verb
def info() -> Info:
    """Print the versions of gradscape and its libraries, and the devices of this machine.

    It writes no file.

    Example: landscape info
    """
    import sys

    from .. import __version__
    from ..envs.engines import installed_version
    from ..envs.engines.runtime import cores, device_names
    from ..jobs.scene import ABSENT, PACKAGES

    packages = {package: installed_version(package) or ABSENT for package in PACKAGES}
    return Info(__version__, sys.version.split()[0], packages, cores(), tuple(device_names()))
