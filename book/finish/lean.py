"""Takes away what pages load or a site ships and nobody uses."""

from __future__ import annotations

import re
from pathlib import Path

from bs4 import BeautifulSoup

SEARCH = ("searchtools.js", "language_data.js", "searchindex.js")
SOURCE_MAP = re.compile(r"\s*/[/*]# sourceMappingURL=\S+?\.map(\s*\*/)?\s*$")


def make_lean(name: str, page: BeautifulSoup) -> None:
    """Scripts of the search enter its own page only; pictures come when they are scrolled to."""
    if name != "search.html":
        for script in page.select("script[src]"):
            if str(script["src"]).split("?")[0].endswith(SEARCH):
                script.decompose()
    for picture in page.select(".bd-article img"):
        picture.attrs |= {"loading": "lazy", "decoding": "async"}


def remove_source_maps(html: Path) -> None:
    """Maps of the theme's scripts and styles to files that are not here."""
    for path in html.rglob("*.map"):
        path.with_suffix("").write_text(
            SOURCE_MAP.sub("\n", path.with_suffix("").read_text(encoding="utf-8")), encoding="utf-8"
        )
        path.unlink()
