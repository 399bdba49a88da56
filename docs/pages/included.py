"""Which page shows what stands at the repository's root, and links that lead to it, here and there."""

from __future__ import annotations

import re

INCLUDED = {
    "README.md": "index.md",
    "BENCHMARKS.md": "benchmarks.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}
PACKAGE = "example_package"  # a folder, to which a link leads where the repository is read


def lead_to_pages(text: str) -> str:
    """Let links to pages of the root lead to those that show them, and one to a folder to a page of its files."""
    for name, here in INCLUDED.items():
        text = re.sub(rf"\]\(((?:\.\./)*)\.\./{re.escape(name)}", rf"](\g<1>{here}", text)
    return text.replace(f"]({PACKAGE})", f"](generated/{PACKAGE}.md)")
