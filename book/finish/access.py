"""What screen readers and keyboards need and the theme leaves out."""

from __future__ import annotations

from bs4 import BeautifulSoup


def make_accessible(page: BeautifulSoup) -> None:
    """Names, roles and headers that say what is there."""
    for element in page.select("summary[aria-label], button[aria-label]"):
        if element.get_text(strip=True):  # a control is called what is written on it
            del element["aria-label"]
    for sidebar in page.select("#pst-primary-sidebar"):
        sidebar.attrs |= {"role": "navigation", "aria-label": "Book"}
    for entry in page.select('.citation-list > [role="doc-biblioentry"]'):
        entry["role"] = "listitem"
    for header in page.select("th"):
        if not header.get_text(strip=True) and not header.find(["img", "svg"]):
            header.name = "td"  # a corner without words heads nothing
