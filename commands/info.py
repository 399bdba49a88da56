"""`landscape info`: versions and devices."""

from __future__ import annotations


def info() -> None:
    """Print the versions of gradscape and its libraries, and the devices of this machine.

    It writes no file.

    Example: landscape info
    """
    import sys

    from .. import __version__
    from ..envs.engines.runtime import cores, device_names
    from ..envs.installed import installed_version
    from ..jobs.scene import ABSENT, PACKAGES
    from .terminal import Console, table

    found = table("what", "version or name", title=f"gradscape {__version__}")
    found.add_row("python", sys.version.split()[0])
    for package in PACKAGES:
        found.add_row(package, installed_version(package) or ABSENT)
    found.add_row("cpu", f"{cores()} cores for this process")
    for name in device_names() or ["none found"]:
        found.add_row("cuda", name)
    Console().print(found)
