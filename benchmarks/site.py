"""Build the gallery's site from the data that it keeps, and say what that takes against what it may.

    python -m benchmarks.site [--data FOLDER]

Prints, in shares of 60 s and of 200 MB: the wall time of the build, and the processor time of all its processes, which
is what one core would take; the weight of the site and of its kinds of files; and the time and the weight of a figure.
Before, it says how many cores there are, and how busy they were.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter
from pathlib import Path

from gradscape.gallery.figures import read_figures
from gradscape.gallery.files import data_folder
from gradscape.gallery.site.build import build_site

SECONDS, BYTES = 60.0, 200e6  # that it may take


def used() -> float:
    """Return what processors this process and those that it began have used [s]."""
    now = os.times()
    return now.user + now.system + now.children_user + now.children_system


def main() -> None:
    """Print what a build takes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data")
    data = data_folder(parser.parse_args().data)
    busy, begun, before = os.getloadavg()[0], time.perf_counter(), used()
    with tempfile.TemporaryDirectory() as folder:
        manifest = build_site(read_figures(), data, Path(folder) / "site")
        seconds, processor = time.perf_counter() - begun, used() - before
        weights = Counter[str]()
        for file in Path(folder).rglob("*"):
            if file.is_file():
                weights[file.suffix] += file.stat().st_size
    cores, figures, weight = len(os.sched_getaffinity(0)), len(manifest.figures), sum(weights.values())
    print(f"{cores} cores, {busy:.1f} of them busy before")
    print(f"time of {SECONDS:.0f} s          {seconds / SECONDS:6.0%}   {seconds / figures:6.2f} s a figure")
    print(f"processors of {SECONDS:.0f} s    {processor / SECONDS:6.0%}   {processor / figures:6.2f} s a figure")
    print(f"weight of {BYTES / 1e6:.0f} MB       {weight / BYTES:6.0%}   {weight / figures / 1e6:6.2f} MB a figure")
    for kind, part in weights.most_common(6):
        print(f"  {kind or 'other':21}{part / BYTES:6.1%}")


if __name__ == "__main__":
    main()
