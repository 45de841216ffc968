"""Tables are as narrow as their numbers allow: cells wrap, but never within an interval."""

from __future__ import annotations

import re

from bs4 import BeautifulSoup

INTERVAL = re.compile(r"\[[^\[\],\s]+, [^\[\],\s]+\]|\S+ ± \S+")
NO_BREAK = "\N{NO-BREAK SPACE}"


def keep_intervals(page: BeautifulSoup) -> None:
    """`0.75 [0.73, 0.76]` may only wrap before its bracket, `97.7 ± 5.4` not at all."""
    for cell in page.select(".bd-article td"):
        for text in cell.find_all(string=INTERVAL):
            text.replace_with(INTERVAL.sub(lambda m: m[0].replace(" ", NO_BREAK), text))
