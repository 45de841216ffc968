"""The site for people who use a screen reader, a keyboard, a phone or paper: axe and our own."""

from __future__ import annotations

from pathlib import Path

import pytest
from browse import PHONE, WIDE, new_context, open_page

AXE = (Path(__file__).parent / "axe" / "axe.min.js").read_text(encoding="utf-8")
FINDINGS = """async () => {
  const found = await axe.run(document, {resultTypes: ["violations"]});
  return found.violations
    .filter(rule => ["serious", "critical"].includes(rule.impact))
    .map(rule => `${rule.id}: ${rule.nodes.map(node => node.html.slice(0, 100)).join(" ")}`);
}"""
OPEN = "document.querySelectorAll('.bd-article details').forEach(fold => { fold.open = true; })"
FOLDED = "document.querySelectorAll('.bd-article details').length"
# Whatever reaches beyond the text on a sheet of paper is cut.
CUT = """() => {
  const paper = document.querySelector('.bd-article').getBoundingClientRect().right + 1;
  return [...document.querySelectorAll('.bd-article :is(table, img, pre, svg)')]
    .filter(e => e.checkVisibility() && e.getBoundingClientRect().right > paper)
    .map(e => `${e.tagName} ${e.innerText?.slice(0, 60)}`);
}"""
PAPER = {"width": 658, "height": 980}  # A4 without margins, at 96 dots per inch


def themed(browser, viewport: dict, mode: str):
    context = new_context(browser, viewport)
    context.add_init_script(f"localStorage.setItem('mode', '{mode}')")
    context.add_init_script(f"localStorage.setItem('theme', '{mode}')")
    return context


STILL = "*, ::before, ::after { animation: none !important; transition: none !important }"


def found_by_axe(page, folds_open: bool) -> list[str]:
    """What is wrong; colours are those that stay when folds have come up."""
    page.add_style_tag(content=STILL)
    if folds_open:
        page.evaluate(OPEN)
    page.evaluate(AXE)
    return page.evaluate(FINDINGS)


@pytest.mark.parametrize(
    ("viewport", "mode", "folds_open"),
    [
        pytest.param(WIDE, "light", True, id="wide-light-open"),
        pytest.param(PHONE, "dark", False, id="phone-dark-closed"),
        *(
            pytest.param(viewport, mode, folds_open, marks=pytest.mark.slow)
            for viewport in (WIDE, PHONE)
            for mode in ("light", "dark")
            for folds_open in (False, True)
        ),
    ],
)
def test_axe_finds_nothing_serious(browser, built_site, page_names, viewport, mode, folds_open):
    found = {}
    with themed(browser, viewport, mode) as context:
        page = context.new_page()
        for name in page_names:
            open_page(page, f"{built_site.as_uri()}/{name}")
            found[name] = found_by_axe(page, folds_open)
    assert {name: findings for name, findings in found.items() if findings} == {}


def test_axe_finds_what_is_planted(browser, tmp_path):
    (tmp_path / "bad.html").write_text(
        "<!doctype html><html lang=en><title>Bad</title><main><h1>Bad</h1><button></button></main>"
    )
    with new_context(browser) as context:
        page = context.new_page()
        open_page(page, f"{tmp_path.as_uri()}/bad.html")
        assert any("button-name" in finding for finding in found_by_axe(page, False))


@pytest.mark.parametrize("viewport", [WIDE, PHONE], ids=["wide", "phone"])
def test_the_first_screen_has_the_finding_a_picture_and_three_paths(browser, built_site, viewport):
    with new_context(browser, viewport) as context:
        page = context.new_page()
        open_page(page, f"{built_site.as_uri()}/intro.html")
        parts = [".finding p", ".finding img.only-light", ".paths .sd-card >> nth=2"]
        for part in parts:
            box = page.locator(part).first.bounding_box()
            assert box["y"] + box["height"] <= viewport["height"], part


def test_paper_cuts_nothing(browser, built_site, page_names):
    with new_context(browser, PAPER) as context:
        page = context.new_page()
        page.emulate_media(media="print")
        cut = {}
        for name in page_names:
            open_page(page, f"{built_site.as_uri()}/{name}")
            if page.locator(".bd-article").count():
                cut[name] = page.evaluate(CUT)
    assert {name: elements for name, elements in cut.items() if elements} == {}
