"""The check of a built site finds what is planted in it, and nothing in one that is sound."""

from __future__ import annotations

from pathlib import Path

import pytest
from docs.pages.check import find_faults, main

pytestmark = pytest.mark.docs

SOUND = """<html><head><link rel="stylesheet" href="_static/a.css"><link rel="canonical" href="https://example.org/">
<script src="_static/a.js?v=1"></script></head><body><h1 id="top">Page</h1><a href="#top">up</a>
<a href="sub/other.html#there">other</a><a href="https://arxiv.org">away</a>
<a href="sub/other.html#node=3,4">a state of a page</a><img src="a.png" alt="a circle">
<img src="data:image/png;base64,AAAA" alt="a dot"><a href="mailto:a@b">mail</a></body></html>"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "sub").mkdir()
    (tmp_path / "_static").mkdir()
    for name, text in (("_static/a.css", "p { background: url(b.png) }"), ("_static/a.js", ""), ("a.png", "")):
        (tmp_path / name).write_text(text)
    (tmp_path / "index.html").write_text(SOUND)
    (tmp_path / "sub/other.html").write_text('<p id="there">there</p><a href="../index.html">back</a>')
    (tmp_path / "_static/template.html").write_text('<script src="{{ nowhere }}"></script>')  # of a theme, no page
    return tmp_path


def test_a_sound_site_has_no_fault(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert list(find_faults(site)) == []
    with pytest.raises(SystemExit) as left:
        main(str(site))
    assert left.value.code == 0
    assert capsys.readouterr().out.strip() == "2 pages, 0 faults"


@pytest.mark.parametrize(
    ("planted", "said"),
    [
        ('<script src="https://cdn.example/x.js"></script>', "loads https://cdn.example/x.js"),
        ('<script src="//cdn.example/x.js"></script>', "loads //cdn.example/x.js"),
        ('<link rel="preload stylesheet" href="HTTP://fonts.example/f.css">', "loads HTTP://fonts.example/f.css"),
        ('<img src="http://pictures.example/p.png" alt="p">', "loads http://pictures.example/p.png"),
        ('<video poster="https://pictures.example/p.png"></video>', "loads https://pictures.example/p.png"),
        ("<style>@import 'https://fonts.example/f.css';</style>", "loads https://fonts.example/f.css"),
        ('<p style="background: url(https://fonts.example/b.png)">x</p>', "loads https://fonts.example/b.png"),
        ('<form action="https://search.example/"></form>', "loads https://search.example/"),
        ('<a href="gone.html">x</a>', "gone.html leads nowhere"),
        ('<a href="sub/other.html#gone">x</a>', "sub/other.html#gone leads to no anchor"),
        ('<a href="#gone">x</a>', "#gone leads to no anchor"),
        ('<a href="sub/gone.html#node=3,4">x</a>', "sub/gone.html#node=3,4 leads nowhere"),
        ('<img src="gone.png" alt="gone away">', "gone.png leads nowhere"),
        ('<img src="a.png">', "shows a.png without an alternative text"),
        ('<img src="sub/../a.png" alt="_images/a.png">', "without an alternative text"),
    ],
)
def test_what_is_planted_is_found(site: Path, planted: str, said: str) -> None:
    (site / "index.html").write_text(SOUND.replace("</body>", f"{planted}</body>"))
    (fault,) = find_faults(site)
    assert said in fault
    with pytest.raises(SystemExit) as left:
        main(str(site))
    assert left.value.code == 1


def test_a_style_sheet_that_asks_elsewhere_is_found(site: Path) -> None:
    (site / "_static/a.css").write_text("@font-face { src: url('https://fonts.example/f.woff2') }")
    assert list(find_faults(site)) == ["_static/a.css loads https://fonts.example/f.woff2"]


def test_a_folder_without_pages_is_no_site(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as left:
        main(str(tmp_path))
    assert left.value.code == 1
