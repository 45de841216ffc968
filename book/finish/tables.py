"""Tables are as narrow as their numbers allow: cells wrap, but never within an interval."""

from __future__ import annotations

import html
import re

from bs4 import BeautifulSoup

INTERVAL = re.compile(r"\[[^\[\],\s]+, [^\[\],\s]+\]|\S+ ± \S+")


def keep_intervals(page: BeautifulSoup) -> None:
    """`0.75 [0.73, 0.76]` may only wrap before its bracket, `97.7 ± 5.4` not at all."""
    for cell in page.select(".bd-article td"):
        for text in cell.find_all(string=INTERVAL):
            marked = INTERVAL.sub(r'<span class="interval">\g<0></span>', html.escape(text))
            text.replace_with(*list(BeautifulSoup(marked, "html.parser").children))
