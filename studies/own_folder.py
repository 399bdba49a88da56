"""Where the user's own measurements are kept."""

from __future__ import annotations

from pathlib import Path

from platformdirs import user_data_path

STUDIES = "studies"


def own_folder() -> Path:
    """Return where the user's own studies are kept."""
    return user_data_path("gradscape") / STUDIES
