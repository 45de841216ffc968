"""The theme's icons, drawn into the pages: its script has two thousand (1.5 MB), a page a dozen."""

from __future__ import annotations

import functools
import re
from pathlib import Path

from bs4 import BeautifulSoup

from finish.equations import parsed
from messages import BuildError

SCRIPT = "_static/scripts/fontawesome.js"
STYLES = {"fa-solid", "fas"}
ICON = r'(?<![\w-])"?{name}"?:\[(\d+),(\d+),\[[^\]]*\],"\w+","([^"]+)"\]'


def draw_icons(pages: dict[str, BeautifulSoup], html: Path) -> None:
    """Put SVG in the place of ``<i class="fa-solid fa-NAME">``, and take the script away."""
    library = (html / SCRIPT).read_text(encoding="utf-8") if (html / SCRIPT).exists() else ""
    for page in pages.values():
        for icon in page.select("i.fa-solid, i.fas"):
            classes = [str(name) for name in icon.get_attribute_list("class")]
            [name] = [c.removeprefix("fa-") for c in classes if c not in {*STYLES, "fa-lg"}
                      and c.startswith("fa-")]  # fmt: skip
            drawing = parsed(svg(name, library))
            drawing["class"] = ["icon", *classes]
            for key, value in icon.attrs.items():
                drawing.attrs.setdefault(key, value)
            icon.replace_with(drawing)
        for script in page.select(f'script[src^="{SCRIPT}"]'):
            script.decompose()
    (html / SCRIPT).unlink(missing_ok=True)


@functools.cache
def svg(name: str, library: str) -> str:
    """An icon of the solid style, which is the last one of each name in the library."""
    found = re.findall(ICON.format(name=re.escape(name)), library)
    if not found:
        raise BuildError(f"The theme's icons have no {name!r}")
    width, height, path = found[-1]
    return (
        f'<svg aria-hidden="true" focusable="false" viewBox="0 0 {width} {height}">'
        f'<path fill="currentColor" d="{path}"></path></svg>'
    )
