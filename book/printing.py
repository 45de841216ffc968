"""The whole book as one PDF: all pages behind each other, printed by Chromium where it is there."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from urllib.parse import urldefrag

from bs4 import BeautifulSoup, Tag
from playwright.sync_api import Error, Page, sync_playwright
from pypdf import PdfReader

from messages import BuildError
from profiles import read_yaml, toc_entries

NAME = "book.pdf"
LINK = f'The whole book to print: <a href="{NAME}" download>{NAME}</a>.\n'
LEFT_OUT = ("api", "licences")  # long lists, which nobody reads on paper
FOOTER = (
    '<div style="font: 8px sans-serif; text-align: center; width: 100%">'
    '<span class="pageNumber"></span></div>'
)
ON_SCREEN = "video, button, script, noscript, details.hide, .only-dark, .headerlink"
NOTHING = "<span></span>"
# The contents of the first printing say nothing of pages; what came out tells the second.
NUMBER_CONTENTS = """numbers => document.querySelectorAll('.page-number')
  .forEach(number => { number.textContent = numbers[number.dataset.of]; })"""
MOST_SECONDS = 300  # of each step; a minute is usual on a slow machine
MARGINS = {"top": "18mm", "bottom": "18mm", "left": "18mm", "right": "18mm"}


def chromium() -> str | None:
    """The browser, if this machine has one."""
    return shutil.which("chromium") or shutil.which("chromium-browser")


def print_book(html: Path, root: Path) -> None:
    """Write ``book.pdf`` of all pages in the order of the table of contents, beside them."""
    program = chromium()
    if program is None:
        print("There is no Chromium here, so the site has no PDF of the book", file=sys.stderr)
        return
    listed = toc_entries(read_yaml(root, "_toc.yml"))
    names = [name for name in listed if name not in LEFT_OUT]
    together = html / "together.html"
    together.write_text(str(joined(html, names)), encoding="utf-8")
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
            page = browser.new_page()
            page.set_default_timeout(MOST_SECONDS * 1000)
            page.goto(together.resolve().as_uri(), wait_until="load")
            write_pdf(page, html / NAME)
            page.evaluate(NUMBER_CONTENTS, page_numbers(html / NAME))
            write_pdf(page, html / NAME)
            browser.close()
    except Error as error:
        raise BuildError(
            f"{program} could not print the book; the last good site is untouched. It said:\n"
            f"{error.message}"
        ) from error
    together.unlink()


def write_pdf(page: Page, path: Path) -> None:
    page.pdf(
        path=path, format="A4", margin=MARGINS, print_background=True, outline=True, tagged=True,
        display_header_footer=True, header_template=NOTHING, footer_template=FOOTER,
    )  # fmt: skip


def page_numbers(path: Path) -> dict[str, int]:
    """On which page every anchor stands that a link of the printed book leads to."""
    reader = PdfReader(path)
    return {
        name.removeprefix("/"): reader.get_destination_page_number(place) + 1
        for name, place in reader.named_destinations.items()
    }


def joined(html: Path, names: list[str]) -> BeautifulSoup:
    """One page of all: its anchors say whose they are, and its links stay inside."""
    pages = {
        name: BeautifulSoup((html / f"{name}.html").read_text(encoding="utf-8"), "html.parser")
        for name in names
    }
    whole = pages[names[0]]
    for element in whole.select("script, noscript"):
        element.decompose()
    [html_element] = whole.select("html")
    html_element["data-theme"] = "light"
    articles = [article_of(name, page, names) for name, page in pages.items()]
    glyphs = [page.find("svg", style="display: none") for page in pages.values()]
    body = whole.body
    assert body is not None
    body.clear()
    body["class"] = ["whole-book"]
    main = whole.new_tag("main", attrs={"class": "bd-article bd-content"})
    listed = contents(whole, articles[1:])
    for part in [*filter(None, glyphs), articles[0], listed, *articles[1:]]:
        main.append(part)
    body.append(main)
    return whole


def article_of(name: str, page: BeautifulSoup, names: list[str]) -> Tag:
    """A page without what only a screen needs: films are strips, folded code stays away."""
    [article] = page.select("article.bd-article")
    for element in article.select(ON_SCREEN):
        element.decompose()
    for fold in article.select("details"):
        fold["open"] = ""
    for picture in article.select("img"):
        picture["loading"] = "eager"
    for element in article.select("[id]"):
        element["id"] = f"{name}--{element['id']}"
    for link in article.select("a[href]"):
        link["href"] = within(str(link["href"]), name, names)
    article["id"] = f"page--{name}"
    article["class"] = ["chapter"]
    return article


def within(link: str, name: str, names: list[str]) -> str:
    """An address inside the one page, where it led to a page that is part of it."""
    address, anchor = urldefrag(link)
    target = address.removesuffix(".html") or name
    if target not in names:
        return link
    return f"#{target}--{anchor}" if anchor else f"#page--{target}"


def contents(whole: BeautifulSoup, articles: list[Tag]) -> Tag:
    """The chapters and their sections."""
    nav = whole.new_tag("nav", attrs={"class": "chapter book-contents"})
    heading = whole.new_tag("h1")
    heading.string = "Contents"
    nav.append(heading)
    for article in articles:
        for section in article.select("section[id]"):
            title = section.find(["h1", "h2"], recursive=False)
            if isinstance(title, Tag):
                line = whole.new_tag("p", attrs={"class": f"entry-{title.name}"})
                link = whole.new_tag("a", attrs={"href": f"#{section['id']}"})
                link.string = title.get_text(strip=True)
                number = whole.new_tag("span", attrs={"class": "page-number"})
                number.attrs["data-of"] = section["id"]
                number.string = "000"
                line.extend([link, number])
                nav.append(line)
    return nav
