"""The menu of downloads on every page: the notebook, what it needs to run, the book on paper."""

from __future__ import annotations

from bs4 import BeautifulSoup

import archive
import printing

ITEMS = {archive.NAME: "source of the book (.zip)", printing.NAME: "whole book (.pdf)"}


def add_downloads(page: BeautifulSoup) -> None:
    """Offer what the site has of itself; the notebook of the page stands there already."""
    for menu in page.select(".dropdown-download-buttons .dropdown-menu"):
        for name, text in ITEMS.items():
            if name == printing.NAME and not printing.chromium():
                continue
            item, link = page.new_tag("li"), page.new_tag("a", attrs={"href": name})
            link.attrs |= {"class": "btn btn-sm dropdown-item", "download": ""}
            link.string = text
            item.append(link)
            menu.append(item)
