"""The Sphinx extension: it writes the generated pages, redirects links between folders, copies the gallery, and writes
formulas as MathML, which needs no script and works with screen readers.
"""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

from . import commands, reproduction, scenes
from .kept import Kept
from .pictures import draw_slice
from .text import render

ROOT = Path(__file__).resolve().parents[2]
WAY_BACK = re.compile("<!-- documentation (.*?) -->")  # a place in the gallery's pages
INCLUDED = {  # what stands at the repository's root, and the page that shows it
    "README.md": "index.md",
    "BENCHMARKS.md": "benchmarks.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}


def pages(kept: Kept, pictures: Path) -> dict[str, str]:
    """Return all pages by their paths under `generated/`, and draw their pictures into a folder."""
    wall = render("wall.md", kept=kept, draw=partial(draw_slice, folder=pictures))
    licence = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["license"]
    figures = render("figures.md", kept=kept, licence=licence, drawn=pictures_of_pages())
    return (
        commands.pages()
        | scenes.pages(kept, pictures)
        | reproduction.pages(kept, pictures)
        | {"wall.md": wall, "figures.md": figures}
    )


def pictures_of_pages() -> dict[str, tuple[list[str], str]]:
    """Return for each picture of `docs` the pages that show it, and the command that made it."""
    texts = {file.name: file.read_text() for file in sorted((ROOT / "docs").glob("*.md"))}
    texts |= {here: (ROOT / name).read_text() for name, here in INCLUDED.items()}
    made = tomllib.loads((ROOT / "docs/pictures.toml").read_text())
    return {
        name: ([page for page, text in texts.items() if re.search(rf"\((docs/)?{re.escape(name)}\)", text)], command)
        for name, command in sorted(made.items())
    }


def write_pages(app: Sphinx) -> None:
    """Write the generated pages into their folder, and remove old ones."""
    if app.config.walked:
        folder = Path(app.srcdir) / "generated"
        write(pages(Kept.read(gallery=gallery_site(app)), folder / "pictures"), folder)


def write(pages: Mapping[str, str], folder: Path) -> None:
    """Write pages into a folder and remove others; an unchanged page is not written, so it is not built again."""
    for old in folder.rglob("*.md"):
        if old.relative_to(folder).as_posix() not in pages:
            old.unlink()
    for name, text in pages.items():
        file = folder / name
        if not file.exists() or file.read_text() != text:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)


def mend_links(app: Sphinx, docname: str, source: list[str]) -> None:
    """Redirect links to files of the root, and to the example package, to the pages that show them."""
    for name, here in INCLUDED.items():
        source[0] = re.sub(rf"\]\(((?:\.\./)*)\.\./{re.escape(name)}", rf"](\g<1>{here}", source[0])
    source[0] = source[0].replace("](example_package)", "](example.md)")


def tidy_shapes(app: Sphinx, what: str, name: str, one: Any, options: Any, said: str | None, back: str | None) -> Any:
    """Remove the blank in shapes such as " dim", which is there for the linter only."""
    return tuple(text and text.replace("' ", "'") for text in (said, back))


def gallery_site(app: Sphinx) -> Path | None:
    """Return the folder of the built gallery, or None without one."""
    named = ROOT / app.config.gallery_site
    return named if (named / "manifest.json").is_file() else None


def take_gallery(app: Sphinx, error: Exception | None) -> None:
    """Copy the gallery's site next to the pages, with a link back; do nothing without a gallery."""
    if error is None and app.builder.format == "html":
        place = Path(app.outdir) / "gallery"
        shutil.rmtree(place, ignore_errors=True)
        if found := gallery_site(app):
            shutil.copytree(found, place)
            for page in place.rglob("*.html"):
                text = page.read_text(encoding="utf-8")
                page.write_text(
                    WAY_BACK.sub(r'<li><a href="\1../index.html">Documentation</a></li>', text), encoding="utf-8"
                )


def write_inline(writer: HTML5Translator, node: nodes.math) -> None:
    """Write an inline formula."""
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def write_block(writer: HTML5Translator, node: nodes.math_block) -> None:
    """Write a displayed formula."""
    writer.body.append(f'<div class="formula">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.add_config_value("gallery_site", "out/gallery", "html")
    app.add_config_value("walked", True, "env")
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-signature", tidy_shapes)
    app.connect("source-read", mend_links)
    app.connect("build-finished", take_gallery)
    app.add_html_math_renderer("mathml", inline_renderers=(write_inline, None), block_renderers=(write_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
