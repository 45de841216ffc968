"""Questions answer to the keyboard, terms lead to their meaning, slides can be shown and read."""

import shutil
from pathlib import Path

import pytest
from browse import Visit, new_context, open_page, visit
from test_site import bad_equations, bad_images

ROOT = Path(__file__).resolve().parents[2]
DECKS = sorted(path.stem for path in (ROOT / "book" / "slides").glob("*.md"))
TALL = """() => {
  const found = [];
  for (let k = 0; k < Reveal.getTotalSlides(); k++, Reveal.next()) {
    const slide = Reveal.getCurrentSlide();
    if (slide.scrollHeight > Reveal.getConfig().height)
      found.push(slide.querySelector('h1, h2, h3').innerText);
  }
  return found;
}"""


def test_a_question_answers_to_the_keyboard(browser, built_site):
    """Each answer is a native disclosure: it needs no script, and unfolds by Enter or Space."""
    with new_context(browser) as context:
        page = context.new_page()
        open_page(page, f"{built_site.as_uri()}/lqr.html")
        answers = page.locator(".check").first.locator("details")
        for number, key in enumerate(["Enter", "Space", "Enter"]):
            answer = answers.nth(number)
            why = answer.locator(".sd-summary-content")
            assert not why.is_visible()
            answer.locator("summary").focus()
            page.keyboard.press(key)
            why.wait_for(state="visible")
            right = "right" in answer.get_attribute("class").split()
            assert why.inner_text().startswith("Right." if right else "No.")
            page.keyboard.press("Tab")  # and the next one is reached by Tab
            if number < 2:
                assert (
                    answers.nth(number + 1)
                    .locator("summary")
                    .evaluate("summary => summary === document.activeElement")
                )


def test_every_chapter_has_its_box_its_questions_and_terms(browser, built_site):
    counts = """() => ['.admonition.frame', '.admonition.check', '[href*="glossary.html#term"]']
        .map(selector => document.querySelectorAll('.bd-article ' + selector).length)"""
    with new_context(browser) as context:
        page = context.new_page()
        for chapter in DECKS:
            page.goto(f"{built_site.as_uri()}/{chapter}.html", wait_until="domcontentloaded")
            frames, questions, terms = page.evaluate(counts)
            assert frames == 1, chapter
            assert questions >= 2, chapter
            assert terms >= 1, chapter


@pytest.mark.parametrize("deck", DECKS)
def test_slides_are_whole_and_fit_their_screen(browser, built_site, deck):
    with new_context(browser) as context:
        address = f"{built_site.as_uri()}/slides/{deck}.html"
        seen = visit(context, address)
        assert seen.errors + seen.failures + Visit.external_requests(seen) == []
        assert bad_images(seen) == []
        assert bad_equations(seen) == []
        page = context.new_page()
        open_page(page, address)
        page.wait_for_function("Reveal.isReady()")
        assert page.evaluate("Reveal.getTotalSlides()") >= 5
        assert page.evaluate(TALL) == []


def test_slides_can_be_printed(built_site):
    if not shutil.which("chromium"):
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    for deck in DECKS:
        assert (built_site / "slides" / f"{deck}.pdf").read_bytes().startswith(b"%PDF")
