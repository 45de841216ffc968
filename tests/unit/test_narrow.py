"""Figures for a phone: panels below each other, and the narrow drawing within the wide one."""

import html
import re

import matplotlib.pyplot as plt
import pytest

from experiments.narrow import WIDTH, both, make_narrow


@pytest.fixture
def three():
    """Panels that share an axis, so that the first one alone says what it is."""
    fig, axes = plt.subplots(1, 3, figsize=(10, 3), sharey=True)
    axes[0].set_ylabel("cost")
    yield fig
    plt.close(fig)


def widths(svg: str) -> list[float]:
    return [float(points) for points in re.findall(r'<svg [^>]*?width="([\d.]+)pt"', svg)]


def test_panels_that_would_be_squeezed_stand_below_each_other(three):
    make_narrow(three)
    assert three.get_size_inches().tolist() == [WIDTH, 9]
    assert [ax.get_subplotspec().rowspan.start for ax in three.axes] == [0, 1, 2]
    assert [ax.get_ylabel() for ax in three.axes] == ["cost"] * 3


def test_small_panels_stay_side_by_side_and_each_row_begins_a_line():
    fig, axes = plt.subplots(2, 3, figsize=(8, 5), sharey=True)
    for row, name in zip(axes, ("a", "b"), strict=True):
        row[0].set_ylabel(name)
        row[0].set_title(name)
    make_narrow(fig)
    geometries = {ax.get_subplotspec().get_gridspec().get_geometry() for ax in fig.axes}
    assert geometries == {(4, 2)}
    assert [ax.get_title() for ax in fig.axes[:3]] == ["a", "", ""]
    assert [ax.get_ylabel() for ax in fig.axes] == ["a", "", "a", "b", "", "b"]
    plt.close(fig)


def test_panels_that_are_no_grid_stay_where_they_are():
    fig, axes = plt.subplots(1, 3, figsize=(9, 3))
    axes[1].remove()
    make_narrow(fig)
    assert fig.get_size_inches().tolist() == [WIDTH, 3]
    plt.close(fig)
    make_narrow(plt.figure(figsize=(9, 3)))
    plt.close()


def test_the_wide_drawing_brings_the_narrow_one(three):
    svg = both(three)
    [inside] = re.findall(r'<metadata class="narrow">([^<]*)</metadata>', svg)
    [wide], [narrow] = widths(svg), widths(html.unescape(inside))
    assert wide > 72 * WIDTH > 0.9 * narrow
    assert svg.rstrip().endswith("</metadata></svg>")


def test_a_figure_that_fits_a_phone_is_drawn_once():
    fig, _ = plt.subplots(figsize=(WIDTH, 3))
    assert "metadata class" not in both(fig)
    plt.close(fig)
