"""What the pages need after jupyter-book has made them, done to its files."""

from __future__ import annotations

from pathlib import Path

from bs4 import BeautifulSoup

from finish.access import make_accessible
from finish.downloads import add_downloads
from finish.equations import set_equations
from finish.icons import draw_icons
from finish.lean import make_lean, remove_source_maps
from finish.minus import set_minus
from finish.pictures import adapt_pictures
from finish.tables import fit_tables


def finish(html: Path) -> None:
    """Equations and icons become part of the pages, and what no page needs goes."""
    pages = read_pages(html)
    remove_source_maps(html)
    set_equations(pages)
    draw_icons(pages, html)
    for name, page in pages.items():
        make_accessible(page)
        adapt_pictures(page, html)
        set_minus(page)
        fit_tables(page)
        add_downloads(page)
        make_lean(name, page)
    write_pages(html, pages)


def read_pages(folder: Path) -> dict[str, BeautifulSoup]:
    """The pages in a folder, by the names of their files."""
    return {
        path.name: BeautifulSoup(path.read_text(encoding="utf-8"), "html.parser")
        for path in sorted(folder.glob("*.html"))
    }


def write_pages(folder: Path, pages: dict[str, BeautifulSoup]) -> None:
    """Put changed pages back."""
    for name, page in pages.items():
        (folder / name).write_text(str(page), encoding="utf-8")
