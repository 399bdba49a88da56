"""A site of two pages, built as the whole is: it asks nobody, finds words without a network, and shows formulas."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from docs.pages.check import find_faults

from ..command import PATIENCE

pytestmark = pytest.mark.docs

DOCS = Path(__file__).parents[2] / "docs"
INDEX = """# Small

A page with a formula, $\\\\frac{a}{b} = \\\\sqrt{c}$, and a [link](other.md#a-place), after {cite:t}`antonova2022`.

```{toctree}
other
```

```{bibliography}
```
"""
OTHER = """---
file_format: mystnb
kernelspec: {name: python3, display_name: Python 3}
---

# Other

## A place

The word zirconium stands here, and an option `--refine`.

```{code-cell} python
print(6 * 7, "it is")
```
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("source")
    (source / "index.md").write_text(INDEX.replace("\\\\", "\\"))
    (source / "other.md").write_text(OTHER)
    (source / "gallery").mkdir()
    for name, text in (("manifest.json", "{}"), ("index.html", "<ul><!-- documentation  --></ul>")):
        (source / "gallery" / name).write_text(text)
    shutil.copy(DOCS / "references.bib", source)
    how = ["-c", DOCS, "-D", "walked=0", "-D", f"gallery_site={source / 'gallery'}", "-D", "exclude_patterns=gallery"]
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", *map(str, [*how, source, source / "out"])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return source / "out"


def test_it_is_sound_and_holds_what_was_run_and_the_gallery(small: Path) -> None:
    assert list(find_faults(small)) == []
    assert "42 it is" in (small / "other.html").read_text()
    assert (small / "gallery/manifest.json").read_text() == "{}"
    assert '<a href="../index.html">Documentation</a>' in (small / "gallery/index.html").read_text()
    assert "<mfrac>" in (small / "index.html").read_text()
    assert not re.search(r"<script[^>]*mathjax", (small / "index.html").read_text(), re.IGNORECASE)
    assert "--refine" in (small / "other.html").read_text()


def test_a_browser_is_sent_nowhere_and_finds_a_word(small: Path, browser) -> None:  # type: ignore[no-untyped-def]
    asked: list[str] = []
    page = browser.new_page()
    page.set_default_timeout(PATIENCE)
    page.on("request", lambda request: asked.append(request.url))
    page.goto((small / "index.html").as_uri())
    assert page.locator("math msqrt").bounding_box()["width"] > 0
    page.goto((small / "search.html").as_uri() + "?q=zirconium")
    page.locator("#search-results li a").first.wait_for()
    assert "other.html" in page.locator("#search-results li a").first.get_attribute("href")
    assert [url for url in asked if not url.startswith(("file:", "data:", "blob:"))] == []
    page.close()
