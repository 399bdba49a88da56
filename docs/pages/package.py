"""The example package of the documentation, a file after the other."""

from __future__ import annotations

from pathlib import Path

from .text import page

FOLDER = Path(__file__).resolve().parents[1] / "example_package"
LEXERS = {".py": "python", ".toml": "toml"}


def pages() -> dict[str, str]:
    """Return the page that shows the package."""
    files = [file for file in sorted(FOLDER.rglob("*")) if file.suffix in LEXERS]
    blocks = [f"`{file.relative_to(FOLDER)}`\n\n```{LEXERS[file.suffix]}\n{file.read_text()}```" for file in files]
    said = "[Bring your own simulator](../simulators.md#as-a-package) says what it is for."
    return {"example_package.md": page("A package with an environment", said, *blocks)}
