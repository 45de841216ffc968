"""What the pages need after jupyter-book has made them, done to its files."""

from __future__ import annotations

from pathlib import Path

from bs4 import BeautifulSoup

from finish.access import make_accessible
from finish.downloads import add_downloads
from finish.equations import set_equations
from finish.icons import draw_icons
from finish.lean import make_lean, remove_source_maps
from finish.pictures import adapt_pictures
from finish.tables import keep_intervals


def finish(html: Path) -> None:
    """Equations and icons become part of the pages, and what no page needs goes."""
    paths = {path.name: path for path in sorted(html.glob("*.html"))}
    pages = {
        name: BeautifulSoup(path.read_text(encoding="utf-8"), "html.parser")
        for name, path in paths.items()
    }
    remove_source_maps(html)
    set_equations(pages)
    draw_icons(pages, html)
    for name, page in pages.items():
        make_accessible(page)
        adapt_pictures(page, html)
        keep_intervals(page)
        add_downloads(page)
        make_lean(name, page)
        paths[name].write_text(str(page), encoding="utf-8")
