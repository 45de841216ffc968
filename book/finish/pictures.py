"""Figures are vectors: they follow the page into dark mode, and stay legible on a phone."""

from __future__ import annotations

import copy
import re
from html import unescape
from pathlib import Path

from bs4 import BeautifulSoup, Tag

GREY = re.compile(r"#([0-9a-f]{2})\1\1\b")
NARROW = re.compile(r'<metadata class="narrow">([^<]*)</metadata>')  # by experiments.narrow
PHONE = "(max-width: 600px)"
BLACK = "#000000"
DARKEST, LIGHTEST = 0x12, 0xE6  # of the theme in dark mode: its background, and its text


def adapt_pictures(page: BeautifulSoup, html: Path) -> None:
    """Every figure drawn by matplotlib gets a twin for dark mode, and those for a phone."""
    for picture in page.select('.bd-article img[src$=".svg"]'):
        path = html / str(picture["src"])
        text = path.read_text(encoding="utf-8")
        if "matplotlib" not in text:
            continue
        narrow = path.with_suffix(".narrow.svg")
        if drawing := NARROW.search(text):
            write_twins(narrow, unescape(drawing[1]))
        write_twins(path, NARROW.sub("", text))
        picture.wrap(page.new_tag("div", attrs={"class": "picture"}))
        add_twin(picture)
        if narrow.exists():  # taken out above, or on a page that shows the same figure
            for one in picture.parent.select("img"):
                one.wrap(page.new_tag("picture")).insert(0, for_phone(one, page))


def write_twins(path: Path, text: str) -> None:
    """A drawing, and beside it the one for dark mode."""
    path.write_text(text, encoding="utf-8")
    # Letters name no colour: they have that of the whole.
    light = text.replace("<svg ", f'<svg fill="{BLACK}" ', 1)
    path.with_suffix(".dark.svg").write_text(GREY.sub(mirrored, light), encoding="utf-8")


def mirrored(grey: re.Match) -> str:
    """Black becomes the theme's light, white its dark; colours stay what they are."""
    light = 1 - int(grey[1], 16) / 255
    return "#" + 3 * f"{round(DARKEST + light * (LIGHTEST - DARKEST)):02x}"


def add_twin(picture: Tag) -> None:
    """The theme shows the one or the other."""
    twin = copy.copy(picture)
    twin["src"] = str(picture["src"]).removesuffix(".svg") + ".dark.svg"
    for image, mode in ((picture, "only-light"), (twin, "only-dark")):
        image["class"] = [*image.get_attribute_list("class"), mode, "dark-light"]
        image["class"] = [name for name in image["class"] if name]
    picture.insert_after(twin)


def for_phone(picture: Tag, page: BeautifulSoup) -> Tag:
    """The narrow drawing, of the same mode, which a narrow screen loads instead."""
    source = re.sub(r"(\.dark)?\.svg$", r".narrow\g<0>", str(picture["src"]))
    return page.new_tag("source", attrs={"media": PHONE, "srcset": source})
