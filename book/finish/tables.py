"""Tables fit their screen: intervals stay whole, and on a phone wide rows become blocks."""

from __future__ import annotations

import html
import re

from bs4 import BeautifulSoup, Tag

INTERVAL = re.compile(r"\[[^\[\],\s]+, [^\[\],\s]+\]|\S+ ± \S+")
GAP, LINE = 1, 43  # characters between two columns, and in a line of a table on a phone
SLOT = 16  # and in a third of that line


def fit_tables(page: BeautifulSoup) -> None:
    """Marks what ``book.css`` needs to know of the tables of a page."""
    for table in page.select(".bd-article table"):
        keep_intervals(table)
        if table.thead and "found" not in table.get_attribute_list("class"):
            stack(table)


def keep_intervals(table: Tag) -> None:
    """`0.75 [0.73, 0.76]` may only wrap before its bracket, `97.7 ± 5.4` not at all."""
    for cell in table.select("td"):
        for text in cell.find_all(string=INTERVAL):
            marked = INTERVAL.sub(r'<span class="interval">\g<0></span>', html.escape(text))
            text.replace_with(*list(BeautifulSoup(marked, "html.parser").children))


def stack(table: Tag) -> None:
    """Where a phone is too narrow for the columns, each cell says the name of its own."""
    heads, *rows = (row.find_all(["td", "th"], recursive=False) for row in table.select("tr"))
    # A cell that spans rows is missing in the later ones: columns are counted from the last.
    columns = list(zip(*(padded(row, len(heads)) for row in (heads, *rows)), strict=True))
    if sum(max(map(least_width, column)) + GAP for column in columns) <= LINE:
        return
    table["class"] = [*filter(None, table.get_attribute_list("class")), "stacked"]
    for head, *cells in columns:
        name = head.get_text(" ", strip=True)
        filled = [cell for cell in cells if cell is not None and cell.get_text(strip=True)]
        is_long = any(map(needs_line, filled))
        for cell in filled:
            cell["data-label"] = name
            if is_long:
                cell["class"] = [*filter(None, cell.get_attribute_list("class")), "long"]


def padded(row: list[Tag], length: int) -> list[Tag | None]:
    return [*[None] * (length - len(row)), *row]


def least_width(cell: Tag | None) -> int:
    """Characters of the longest piece that does not wrap."""
    if cell is None:
        return 0
    if "text-right" in cell.get_attribute_list("class"):
        return len(cell.get_text(strip=True))
    pieces = [part.get_text() for part in cell.select(".interval")] + cell.get_text(" ").split()
    equations = [round(float(str(svg["width"])[:-2])) for svg in cell.select("mjx-container > svg")]
    return max([*map(len, pieces), *equations], default=0)


def needs_line(cell: Tag) -> bool:
    """Words, and what is too wide for a third of a line."""
    return least_width(cell) > SLOT or len(cell.get_text(" ", strip=True)) > 2 * SLOT
