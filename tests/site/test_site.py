"""The built site, as a reader meets it: opened from a folder and served, on a wide and a narrow
screen, in light and dark mode."""

from __future__ import annotations

import re
import zipfile
from urllib.parse import urldefrag, urlsplit

import pytest
from browse import PHONE, WIDE_TABLES, Visit, new_context, open_page, visit

import archive
import printing

# Contrast of every piece of visible text with the background that it stands on (WCAG 2).
TEXT_CONTRAST = """() => {
  const linear = (c) => c <= .04045 ? c / 12.92 : ((c + .055) / 1.055) ** 2.4;
  const channel = (c) => linear(c / 255);
  const luminance = ([r, g, b]) => .2126 * channel(r) + .7152 * channel(g) + .0722 * channel(b);
  const parse = (text) => text.match(/[\\d.]+/g).map(Number);
  const background = (e) => {
    for (; e; e = e.parentElement) {
      const colour = parse(getComputedStyle(e).backgroundColor);
      if (colour.length < 4 || colour[3] === 1) return colour;
    }
    return [255, 255, 255];
  };
  const selector = 'h1, h2, h3, p, li, td, th, a, figcaption, .sd-badge, .caption-text, pre';
  return [...document.querySelectorAll('.bd-article :is(' + selector + ')')]
    .filter(e => e.offsetParent && e.innerText.trim() && !e.classList.contains('headerlink'))
    .map(e => {
      const pair = [parse(getComputedStyle(e).color), background(e)].map(luminance);
      const contrast = (Math.max(...pair) + .05) / (Math.min(...pair) + .05);
      return {text: e.tagName + ' ' + e.innerText.slice(0, 40), contrast};
    });
}"""
READABLE = 4.5  # WCAG AA for text
FIRST_PAGE_MB, CHAPTER_MB, PDF_MB = 1, 3, 30
FILM = re.compile(r"data:video/mp4;base64,[A-Za-z0-9+/=]*")


def anchors(visits: dict[str, Visit]) -> set[tuple[str, str]]:
    return {(name, anchor) for name, seen in visits.items() for anchor in seen.content["ids"]}


def broken_links(seen: Visit, visits: dict[str, Visit], built_site) -> list[str]:
    """Links into the site that lead to no file or to no element."""
    home, known = seen.url.rsplit("/", 1)[0], anchors(visits)
    broken = []
    for link in seen.content["links"]:
        url, anchor = urldefrag(link)
        if urlsplit(link).scheme not in ("file", "http", "https") or not url.startswith(home):
            continue
        path = urlsplit(url.removeprefix(home)).path.lstrip("/")
        found = (built_site / path).is_file()
        if not found or (anchor and path.endswith(".html") and (path, anchor) not in known):
            broken.append(link)
    return broken


def bad_images(seen: Visit) -> list[dict]:
    """Images that did not load, or whose text says nothing or only repeats the file's name."""
    return [
        image
        for image in seen.content["images"]
        if not image["loaded"]
        or not image["alt"].strip()
        or re.search(r"\.(png|jpe?g|svg|gif|webp)$", image["alt"])
    ]


def bad_equations(seen: Visit) -> list[str]:
    """Mathematics that was not set, set twice, or set as an error."""
    content = seen.content
    wrong = content["unrendered"] + content["math_errors"] + content["dollars"]
    if content["equations"] != content["math"]:
        wrong.append(f"{content['math']} pieces of mathematics, {content['equations']} equations")
    return wrong


def bad_figures(seen: Visit) -> list[dict]:
    return [
        figure
        for figure in seen.content["figures"]
        if not re.search(r"\d", figure["number"]) or not figure["caption"]
    ]


def by_page(check, visits: dict[str, Visit]) -> dict:
    """What a check finds, for the pages on which it finds something."""
    return {name: found for name, seen in visits.items() if (found := check(seen))}


# --- each page -----------------------------------------------------------------------------------


def test_the_site_has_its_pages(page_names):
    expected = ("index", "intro", "claims", "licences", "references", "run_times")
    assert {f"{name}.html" for name in expected} <= set(page_names)


def test_nothing_comes_from_outside(visits):
    assert all(seen.requests for seen in visits.values())
    assert not by_page(Visit.external_requests, visits)


def test_no_request_fails(visits):
    assert not by_page(lambda seen: seen.failures, visits)


def test_the_console_is_silent(visits):
    assert not by_page(lambda seen: seen.errors, visits)


def test_every_internal_link_leads_somewhere(visits, built_site):
    assert not by_page(lambda seen: broken_links(seen, visits, built_site), visits)


def test_every_image_loads_and_says_what_it_shows(visits):
    assert not by_page(bad_images, visits)


def test_every_equation_is_set(visits):
    assert any(seen.content["equations"] for seen in visits.values())
    assert not by_page(bad_equations, visits)


def test_every_figure_has_a_number_of_its_own_and_a_caption(visits):
    assert not by_page(bad_figures, visits)
    figures = [
        (name, figure["number"])
        for name, seen in visits.items()
        if name != "index.html"  # shows the first page
        for figure in seen.content["figures"]
    ]
    assert figures
    assert len(figures) == len(set(figures))


def test_no_page_scrolls_sideways_on_a_phone(phone_visits):
    widths = {name: seen.content["width"] for name, seen in phone_visits.items()}
    assert {name: width for name, width in widths.items() if width > PHONE["width"]} == {}


def test_no_equation_is_tiny_on_a_phone(phone_visits):
    found = {name: seen.content["shrunk"] for name, seen in phone_visits.items()}
    assert {name: equations for name, equations in found.items() if equations} == {}


def wide_tables(visits: dict[str, Visit]) -> dict[str, list[str]]:
    found = {name: seen.content["wide_tables"] for name, seen in visits.items()}
    return {name: tables for name, tables in found.items() if tables}


def test_no_table_scrolls(visits):
    assert wide_tables(visits) == {}


def test_no_table_scrolls_on_a_phone(phone_visits):
    assert wide_tables(phone_visits) == {}


BETWEEN = (620, 768, 970, 1200, 1300, 1390)  # pixels


def test_no_table_scrolls_beside_the_sidebars(browser, built_site, page_names):
    """Between a phone and a wide screen the column of text is narrow for other reasons."""
    found = {}
    with new_context(browser) as context:
        page = context.new_page()
        for name in page_names:
            open_page(page, f"{built_site.as_uri()}/{name}")
            for width in BETWEEN:
                page.set_viewport_size({"width": width, "height": 900})
                found[name, width] = page.evaluate(WIDE_TABLES)
    assert {where: tables for where, tables in found.items() if tables} == {}


SMALL_LETTERS = 9.6  # points


def test_letters_of_figures_are_seven_pixels_high_on_a_phone(phone_visits):
    tiny = {
        name: [one for one in seen.content["scales"] if one["scale"] * SMALL_LETTERS < 7]
        for name, seen in phone_visits.items()
    }
    assert {name: figures for name, figures in tiny.items() if figures} == {}


# --- weight -------------------------------------------------------------------------------------


def weight(seen: Visit, built_site) -> float:
    """MB that a reader loads of a page: all of it but the films, which wait to be played."""
    home = seen.url.rsplit("/", 1)[0]
    pictures = [f"{home}/{image['source']}" for image in seen.content["images"]]
    own = {urlsplit(url.removeprefix(home)).path.lstrip("/") for url in [*seen.requests, *pictures]}
    files = [built_site / name for name in own if (built_site / name).is_file()]
    total = sum(path.stat().st_size for path in files)
    page = (built_site / urlsplit(seen.url).path.rsplit("/", 1)[-1]).read_text(encoding="utf-8")
    return (total - sum(map(len, FILM.findall(page)))) / 1e6


def test_no_page_is_heavy(visits, built_site):
    weights = {name: weight(seen, built_site) for name, seen in visits.items()}
    assert weights["intro.html"] < FIRST_PAGE_MB
    assert {name: mb for name, mb in weights.items() if mb >= CHAPTER_MB} == {}


def test_nothing_is_shipped_that_no_page_uses(built_site):
    assert not list(built_site.rglob("*.map"))
    assert not list(built_site.rglob("fontawesome.js"))


# --- downloads -----------------------------------------------------------------------------------


def test_the_source_of_the_book_is_offered_without_solutions(built_site):
    with zipfile.ZipFile(built_site / archive.NAME) as source:
        names = {name.removeprefix(f"{archive.INSIDE}/") for name in source.namelist()}
        words = source.read(f"{archive.INSIDE}/Makefile").decode()
    assert "make book" in words or "book:" in words
    assert {"README.md", "environment.txt", "book/build.py", "notebooks/lqr.ipynb"} <= names
    assert not [name for name in names if name.startswith(archive.SOLUTIONS)]


def test_the_whole_book_is_one_pdf(browser, built_site):  # browser: there is a Chromium
    printed = (built_site / printing.NAME).read_bytes()
    assert printed.startswith(b"%PDF")
    assert 0.5e6 < len(printed) < PDF_MB * 1e6


# --- finding and reading -------------------------------------------------------------------------


def search_results(context, address: str, words: str) -> list[str]:
    page = context.new_page()
    open_page(page, f"{address}/search.html?q={words}")
    page.wait_for_selector("#search-results p.search-summary")
    page.wait_for_function(
        "/found|did not match/.test(document.querySelector('p.search-summary').innerText)"
    )
    links = page.eval_on_selector_all("#search-results li a", "all => all.map(a => a.href)")
    page.close()
    return [urlsplit(link).path.rsplit("/", 1)[-1] for link in links]


def test_search_finds_a_word_and_only_where_it_is(browser, address):
    with new_context(browser) as context:
        assert "lqr.html" in search_results(context, address, "distractors")
        assert search_results(context, address, "zyxwvut") == []


def test_the_search_field_leads_to_the_results(browser, address):
    with new_context(browser) as context:
        page = context.new_page()
        open_page(page, f"{address}/intro.html")
        page.keyboard.press("Control+K")
        page.keyboard.type("distractors")
        page.keyboard.press("Enter")
        page.wait_for_url("**/search.html?q=distractors*")
        page.wait_for_selector("#search-results li a")


def switch_to(page, mode: str) -> None:
    for _ in range(3):  # automatic, dark, light
        if page.evaluate("document.documentElement.dataset.mode") == mode:
            return
        page.click(".theme-switch-button:visible")
    pytest.fail(f"the switch does not lead to {mode} mode")


@pytest.mark.parametrize("mode", ["light", "dark"])
def test_text_is_readable_in_both_modes(browser, built_site, page_names, mode):
    with new_context(browser) as context:
        page = context.new_page()
        faint = {}
        for name in page_names:
            open_page(page, f"{built_site.as_uri()}/{name}")
            switch_to(page, mode)  # the choice stays, but a busy browser may store it too late
            assert page.evaluate("document.documentElement.dataset.theme") == mode
            texts = page.evaluate(TEXT_CONTRAST)
            faint[name] = [text for text in texts if text["contrast"] < READABLE]
        assert {name: texts for name, texts in faint.items() if texts} == {}


def test_dark_mode_is_dark_and_figures_are_drawn_for_it(browser, built_site):
    with new_context(browser) as context:
        page = context.new_page()
        open_page(page, f"{built_site.as_uri()}/lqr.html")
        switch_to(page, "dark")
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert max(int(part) for part in re.findall(r"\d+", background)) < 64
        shown = page.eval_on_selector_all(
            ".bd-article .picture img",
            "all => all.filter(i => i.checkVisibility()).map(i => i.getAttribute('src'))",
        )
        assert shown
        assert all(source.endswith(".dark.svg") for source in shown)


def test_paper_gets_the_article_alone(browser, built_site):
    with new_context(browser) as context:
        page = context.new_page()
        page.emulate_media(media="print")
        open_page(page, f"{built_site.as_uri()}/intro.html")
        assert page.is_visible(".bd-article")
        assert not page.is_visible(".bd-sidebar-primary")


# --- the checks themselves -----------------------------------------------------------------------

BROKEN_PAGE = """<!doctype html><title>Broken</title><body class="bd-article">
<script src="https://cdn.invalid/library.js"></script>
<script>console.error("oh"); undefinedName;</script>
<img src="missing.png" alt="">
<a href="nowhere.html">one</a> <a href="broken.html#nothing">two</a>
<span class="math">\\(x\\)</span>
<figure><figcaption>No number</figcaption></figure>
<table><tr><td style="min-width: 2000px">wide</td></tr></table>"""


def test_the_checks_find_the_faults_of_a_broken_page(browser, tmp_path):
    (tmp_path / "broken.html").write_text(BROKEN_PAGE)
    with new_context(browser, PHONE) as context:
        seen = visit(context, f"{tmp_path.as_uri()}/broken.html")
    assert seen.external_requests() == ["https://cdn.invalid/library.js"]
    assert any(url.endswith("missing.png") for url in seen.failures)
    assert any("oh" in error for error in seen.errors)
    assert any("undefinedName" in error for error in seen.errors)
    assert len(broken_links(seen, {"broken.html": seen}, tmp_path)) == 2
    assert bad_images(seen)
    assert bad_equations(seen)
    assert bad_figures(seen)
    assert seen.content["width"] > PHONE["width"]
