"""The folder of the user's own measurements."""

from __future__ import annotations

from pathlib import Path

from platformdirs import user_data_path

STUDIES = "studies"


def own_folder() -> Path:
    """Return the folder of the user's own studies."""
    return user_data_path("gradscape") / STUDIES
