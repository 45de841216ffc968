"""The last steps of the site's pages, on small pieces of HTML."""

import html
import re
import zipfile

import pytest
from bs4 import BeautifulSoup
from playwright.sync_api import Error

import archive
import first_page
import messages
import printing
from finish.access import make_accessible
from finish.equations import set_equations
from finish.icons import svg
from finish.lean import make_lean, remove_source_maps
from finish.minus import set_minus
from finish.pictures import adapt_pictures
from finish.tables import fit_tables
from messages import BuildError


def page(body: str) -> BeautifulSoup:
    return BeautifulSoup(f"<html><body>{body}</body></html>", "html.parser")


def test_punctuation_stays_with_the_equation_before_it():
    one = page(r'<p>(<span class="math">\(x\)</span>), <span class="math">\(y\)</span> and</p>')
    set_equations({"one": one})
    [together] = one.select(".together")
    assert together.get_text().endswith("),") and together.next_sibling == " "
    assert one.p.get_text().startswith("(") and one.p.get_text().endswith(" and")


def test_equations_become_pictures_that_screen_readers_can_read():
    one = page(
        r'<script src="x/mathjax.js"></script><script>window.MathJax = {}</script>'
        r'<span class="math">\(x^2\)</span><div class="math"><a>1</a>\[\frac12\]</div>'
    )
    set_equations({"one": one, "none": page("<p>No equation</p>")})
    inline, displayed = one.select("mjx-container")
    assert inline.find("svg")["aria-hidden"] == displayed.find("svg")["aria-hidden"] == "true"
    assert displayed["display"] == "true" and "display" not in inline.attrs
    assert inline.select_one("mjx-assistive-mml msup") and displayed.select_one("mfrac")
    used = {use["href"].removeprefix("#") for use in one.select("use")}
    assert used == {path["id"] for path in one.select("defs path")}
    assert not one.select("script") and "\\" not in one.get_text()
    assert one.select_one("div.math a").get_text() == "1"


@pytest.mark.parametrize("tex", [r"\nonsense x", r"\frac{x"])
def test_a_mistake_in_tex_ends_the_build_and_is_named(tex):
    with pytest.raises(BuildError, match=re.escape(tex)):
        set_equations({"one": page(rf'<span class="math">\({tex}\)</span>')})


def test_an_icon_is_the_last_of_its_name_and_an_unknown_one_is_an_error():
    library = '{sun:[1,2,[],"f1","M1"]},{"half-sun":[3,4,[],"f2","M2"],"sun":[5,6,[7],"f3","M3"]}'
    assert 'viewBox="0 0 5 6"' in svg("sun", library) and 'd="M3"' in svg("sun", library)
    with pytest.raises(BuildError, match="'moon'"):
        svg("moon", library)


def test_names_roles_and_headers_say_what_is_there():
    one = page(
        '<details><summary aria-label="Toggle">Show code</summary></details>'
        '<button aria-label="Search"><svg></svg></button>'
        '<div class="citation-list"><div role="doc-biblioentry">A</div></div>'
        "<table><tr><th></th><th>n</th></tr></table>"
    )
    make_accessible(one)
    assert "aria-label" not in one.summary.attrs and one.button["aria-label"] == "Search"
    assert one.select_one(".citation-list > [role=listitem]")
    assert [cell.name for cell in one.select("tr > *")] == ["td", "th"]


def test_only_the_search_loads_what_it_needs(tmp_path):
    scripts = '<script src="searchindex.js?v=1"></script><script src="own.js"></script>'
    pages = {name: page(scripts) for name in ("search.html", "lqr.html")}
    for name, one in pages.items():
        make_lean(name, one)
    assert [len(one.select("script")) for one in pages.values()] == [2, 1]
    (tmp_path / "a.css").write_text("p{}\n/*# sourceMappingURL=a.css.map*/")
    (tmp_path / "a.css.map").write_text("{}")
    remove_source_maps(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.css"]
    assert (tmp_path / "a.css").read_text() == "p{}\n"


def test_a_figure_gets_a_twin_for_dark_mode(tmp_path):
    drawing = '<svg width="720pt"><!-- matplotlib --><g style="fill: #ffffff; stroke: #0072b2"/>'
    (tmp_path / "a.svg").write_text(drawing)
    (tmp_path / "b.svg").write_text("<svg/>")
    one = page('<div class="bd-article"><img src="a.svg" alt="A"><img src="b.svg" alt="B"></div>')
    adapt_pictures(one, tmp_path)
    light, dark = one.select(".picture img")
    assert (light["src"], dark["src"], dark["alt"]) == ("a.svg", "a.dark.svg", "A")
    assert "only-light" in light["class"] and "only-dark" in dark["class"]
    twin = (tmp_path / "a.dark.svg").read_text()
    assert 'fill="#e6e6e6"' in twin and "fill: #121212; stroke: #0072b2" in twin
    assert len(one.select("img")) == 3 and not one.select("source")


def test_a_phone_loads_the_narrow_drawing_that_a_wide_one_brings(tmp_path):
    narrow = "<svg>matplotlib, A &amp; B</svg>"
    metadata = f'<metadata class="narrow">{html.escape(narrow)}</metadata>'
    (tmp_path / "_images").mkdir()
    (tmp_path / "_images" / "a.svg").write_text(f"<svg><g>matplotlib</g>{metadata}</svg>")
    figure = '<div class="bd-article"><img src="_images/a.svg" alt="A"></div>'
    pages = [page(figure), page(figure)]
    for one in pages:  # the second finds what the first has taken out
        adapt_pictures(one, tmp_path)
        sources = [source["srcset"] for source in one.select("picture > source[media]")]
        assert sources == ["_images/a.narrow.svg", "_images/a.narrow.dark.svg"]
    assert (tmp_path / "_images" / "a.svg").read_text() == "<svg><g>matplotlib</g></svg>"
    assert (tmp_path / "_images" / "a.narrow.svg").read_text() == narrow


def test_cells_wrap_around_intervals_only():
    cells = "<tr><td>0.75 [0.7, 0.8]</td><td>9 ± 1</td></tr>"
    one = page(f'<div class="bd-article"><table>{cells}</table></div>')
    fit_tables(one)
    assert [whole.get_text() for whole in one.select("td > .interval")] == ["[0.7, 0.8]", "9 ± 1"]
    assert one.td.get_text() == "0.75 [0.7, 0.8]"


def table(heads: list[str], *rows: list[str]) -> BeautifulSoup:
    head, *body = (
        "<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in (heads, *rows)
    )
    whole = f"<table><thead>{head}</thead><tbody>{''.join(body)}</tbody></table>"
    return page(f'<div class="bd-article">{whole}</div>')


def test_only_a_table_that_is_too_wide_for_a_phone_is_stacked():
    narrow, wide = (table(["arm", *["12345"] * num], ["IPO", *["0.93"] * num]) for num in (6, 7))
    for one in (narrow, wide):
        fit_tables(one)
    assert not narrow.select(".stacked, [data-label]")
    assert [cell["data-label"] for cell in wide.select(".stacked tbody td")][:2] == ["arm", "12345"]


def test_words_have_a_line_of_their_own_and_empty_cells_no_name():
    words = "a sentence that is longer than a third of a line"
    one = table(["what", "incomprehensibilities", "n", "p"], [words, words, "", "incomprehensible"])
    fit_tables(one)
    _, long, empty, short = one.select("tbody td")
    assert long["class"] == ["long"] and "class" not in short.attrs
    assert "data-label" not in empty.attrs and short["data-label"] == "p"


def test_columns_are_counted_from_the_last_where_a_cell_spans_rows():
    one = table(["method", "of", "a column of numbers that is wide"], ["IPO", "ours", "1 ± 1"])
    one.tbody.append(BeautifulSoup("<tr><td>paper</td><td>2</td></tr>", "html.parser"))
    one.tbody.tr.td["rowspan"] = "2"
    one.tbody.tr.find_all("td")[2].string = "x" * 40
    fit_tables(one)
    labels = [[cell["data-label"] for cell in row.select("td")] for row in one.select("tbody tr")]
    assert labels[1] == labels[0][1:] and labels[1][0] == "of"


@pytest.mark.parametrize(
    ("typed", "shown"),
    [
        ("-0.03 [-1, -.5]", "−0.03 [−1, −.5]"),
        ("-0.00, [-0, 1]", "0.00, [0, 1]"),
        ("2026-11-27, 5e-4, x^-1, Okabe-Ito, 1-2", "2026-11-27, 5e-4, x^-1, Okabe-Ito, 1-2"),
    ],
)
def test_negative_numbers_have_a_minus_sign(typed, shown):
    one = page(f"<p>{typed}</p><code>{typed}</code>")
    set_minus(one)
    assert one.p.get_text() == shown
    assert one.code.get_text() == typed


def test_the_archive_has_the_sources_and_no_solutions(tmp_path):
    root = tmp_path / "root"
    for name in ("Makefile", "ipo/a.py", "ipo/__pycache__/a.pyc", "book/_build/x.html"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("x")
    for folder in archive.SOLUTIONS:
        (root / folder).mkdir(parents=True)
        (root / folder / "solved.py").write_text("x")
    packages = tmp_path / "_downloads"
    packages.mkdir()
    (packages / "exercises.zip").write_text("x")
    archive.write_archive(root, tmp_path / "a.zip", packages)
    names = zipfile.ZipFile(tmp_path / "a.zip").namelist()
    inside = ("Makefile", "book/_downloads/exercises.zip", "ipo/a.py")
    assert names == [f"{archive.INSIDE}/{name}" for name in inside]
    before = (tmp_path / "a.zip").read_bytes()
    archive.write_archive(root, tmp_path / "a.zip", packages)
    assert (tmp_path / "a.zip").read_bytes() == before


@pytest.mark.parametrize(("address", "is_linked"), [("", False), ("https://example.org/x", True)])
def test_one_setting_says_where_the_repository_is(tmp_path, address, is_linked):
    (tmp_path / "_config.yml").write_text(f'repository: {{url: "{address}"}}\n')
    (tmp_path / "a.zip").write_bytes(b"")
    text = archive.where_to_find_it(tmp_path, tmp_path / "a.zip")
    assert archive.NAME in text
    assert ("https://example.org/x" in text) == is_linked


def test_links_stay_inside_the_printed_book():
    inside = ["lqr", "keys"]
    assert printing.within("keys.html#table", "lqr", inside) == "#keys--table"
    assert printing.within("#table", "lqr", inside) == "#lqr--table"
    assert printing.within("keys.html", "lqr", inside) == "#page--keys"
    assert printing.within("api.html#x", "lqr", inside) == "api.html#x"


def test_without_chromium_there_is_no_pdf_and_a_word_about_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(printing, "chromium", lambda: None)
    printing.print_book(tmp_path, tmp_path)
    assert "no Chromium" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_chromium_that_does_not_work_is_an_error_with_its_words(tmp_path, monkeypatch):
    def refuse():
        raise Error("no such display")

    monkeypatch.setattr(printing, "chromium", lambda: "chromium")
    monkeypatch.setattr(printing, "sync_playwright", refuse)
    (tmp_path / "_toc.yml").write_text("format: jb-book\nroot: intro\n")
    page = "<html><body><article class='bd-article'><h1>Title</h1></article></body></html>"
    (tmp_path / "intro.html").write_text(page)
    with pytest.raises(messages.BuildError, match=r"(?s)chromium could not print.*no such display"):
        printing.print_book(tmp_path, tmp_path)


def test_the_first_sentences_follow_the_verdicts(monkeypatch):
    book = {
        "sentences": [[{"question": "it works", "says": {"reproduced": "it does"}, "results": []}]]
    }
    monkeypatch.setattr(first_page.claims, "read_results", lambda *_: {})
    for verdict, sentence in {
        "reproduced": "It does.",
        "undecided": "Whether it works: undecided.",
    }.items():
        found = first_page.claims.Finding(verdict, "")
        monkeypatch.setattr(first_page.claims, "decide", lambda *_, found=found: found)
        assert first_page.finding(book) == sentence
