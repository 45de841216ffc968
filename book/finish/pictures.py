"""Figures are vectors: they follow the page into dark mode, and stay legible on a phone."""

from __future__ import annotations

import copy
import re
from pathlib import Path

from bs4 import BeautifulSoup, Tag

GREY = re.compile(r"#([0-9a-f]{2})\1\1\b")
WIDTH = re.compile(r'<svg [^>]*?width="([\d.]+)pt"')
BLACK = "#000000"
DARKEST, LIGHTEST = 0x12, 0xE6  # of the theme in dark mode: its background, and its text
NARROW = 340  # pixels of the text on a phone
LEAST_PIXELS_PER_POINT = 0.68  # of a figure's width: letters of 11.5 pt are 8 pixels high then


def adapt_pictures(page: BeautifulSoup, html: Path) -> None:
    """Every figure drawn by matplotlib gets a twin for dark mode and a least width."""
    for picture in page.select('.bd-article img[src$=".svg"]'):
        path = html / str(picture["src"])
        text = path.read_text(encoding="utf-8")
        if "matplotlib" not in text:
            continue
        twin = path.with_suffix(".dark.svg")
        # Letters name no colour: they have that of the whole.
        light = text.replace("<svg ", f'<svg fill="{BLACK}" ', 1)
        twin.write_text(GREY.sub(mirrored, light), encoding="utf-8")
        add_twin(picture, f"{picture['src']}".replace(path.name, twin.name))
        if width := WIDTH.search(text):
            let_scroll(picture, LEAST_PIXELS_PER_POINT * float(width[1]), page)


def mirrored(grey: re.Match) -> str:
    """Black becomes the theme's light, white its dark; colours stay what they are."""
    light = 1 - int(grey[1], 16) / 255
    return "#" + 3 * f"{round(DARKEST + light * (LIGHTEST - DARKEST)):02x}"


def add_twin(picture: Tag, source: str) -> None:
    """The theme shows the one or the other."""
    twin = copy.copy(picture)
    twin["src"] = source
    for image, mode in ((picture, "only-light"), (twin, "only-dark")):
        image["class"] = [*image.get_attribute_list("class"), mode, "dark-light"]
        image["class"] = [name for name in image["class"] if name]
    picture.insert_after(twin)


def let_scroll(picture: Tag, least_width: float, page: BeautifulSoup) -> None:
    """On a narrow screen, a wide figure scrolls sideways in a box of its own."""
    box = page.new_tag("div", attrs={"class": "picture", "style": f"--least: {least_width:.0f}px"})
    if least_width > NARROW:
        box.attrs |= {"tabindex": "0", "role": "group", "aria-label": "Figure"}
    twin = picture.find_next_sibling("img")
    picture.wrap(box)
    if twin:
        box.append(twin.extract())
