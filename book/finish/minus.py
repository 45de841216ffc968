"""Negative numbers have the sign that equations have, wherever they come from."""

from __future__ import annotations

import re

from bs4 import BeautifulSoup

# A hyphen before digits, that no word, power or name goes on with.
HYPHEN = re.compile(r"(?<![\w.^/-])-(?=\.?\d)")
ZERO = re.compile(r"(?<![\w.^/-])-(?=0(\.0+)?(?![\d.]))")  # what is rounded to nothing has none
AS_TYPED = ["code", "pre", "script", "style", "mjx-container", "textarea"]


def set_minus(page: BeautifulSoup) -> None:
    """`-0.03` in prose, tables and captions becomes `−0.03`, and `-0.00` becomes `0.00`."""
    for text in page.find_all(string=HYPHEN):
        if not text.find_parent(AS_TYPED):
            text.replace_with(HYPHEN.sub("−", ZERO.sub("", text)))
