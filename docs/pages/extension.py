"""The Sphinx extension: writes the pages that are walked, mends links between folders, and takes the gallery in."""

from __future__ import annotations

import shutil
from pathlib import Path

from sphinx.application import Sphinx

from . import mathml
from .included import lead_to_pages
from .interface import tidy_shapes, to_rst
from .walked import write_pages

ROOT = Path(__file__).resolve().parents[2]


def mend_links(app: Sphinx, docname: str, source: list[str]) -> None:
    """Let links lead to pages of the site."""
    source[0] = lead_to_pages(source[0])


def take_gallery(app: Sphinx, error: Exception | None) -> None:
    """Put the gallery's site beside the pages, in the place of an earlier one; nothing where there is none."""
    if error is None and app.builder.format == "html":
        place = Path(app.outdir) / "gallery"
        shutil.rmtree(place, ignore_errors=True)
        if found := gallery_site(app):
            shutil.copytree(found, place)


def gallery_site(app: Sphinx) -> Path | None:
    """Return where the built gallery is, None where there is none."""
    named = ROOT / app.config.gallery_site
    return named if (named / "manifest.json").is_file() else None


def walk(app: Sphinx) -> None:
    """Write what is walked."""
    if app.config.walked:
        write_pages(Path(app.srcdir) / "generated", gallery=gallery_site(app))


def setup(app: Sphinx) -> dict[str, bool]:
    """Say what the extension adds."""
    app.add_config_value("gallery_site", "out/gallery", "html")
    app.add_config_value("walked", True, "env")
    app.connect("builder-inited", walk)
    app.connect("autodoc-process-docstring", to_rst)
    app.connect("autodoc-process-signature", tidy_shapes)
    app.connect("source-read", mend_links)
    app.connect("build-finished", take_gallery)
    mathml.setup(app)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
