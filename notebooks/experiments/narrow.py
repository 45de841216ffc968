"""A figure drawn again for a phone: narrow, its panels below each other, its letters as large."""

from __future__ import annotations

import html
import math

from IPython.core.pylabtools import print_figure
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec

WIDTH = 6.2  # inches: on 340 pixels, letters of 9.6 points ("small") are 7 pixels high


def both(fig: Figure) -> str:
    """A figure as SVG, and within it, where it is too wide for a phone, the narrow one as text.

    The build of the site takes it out again (``book/finish/pictures.py``). The figure stays narrow.
    """
    wide = _svg(fig)
    if fig.get_figwidth() <= WIDTH:
        return wide
    make_narrow(fig)
    head, end, tail = wide.rpartition("</svg>")
    return f'{head}<metadata class="narrow">{html.escape(_svg(fig))}</metadata>{end}{tail}'


def _svg(fig: Figure) -> str:
    return print_figure(fig, fmt="svg", bbox_inches="tight", metadata={"Date": None})


def make_narrow(fig: Figure) -> None:
    """As many panels in a row as keep their width; what stood in one row takes some lines.

    Panels that are no whole grid stay where they are.
    """
    width, height = fig.get_size_inches()
    panels = [ax for ax in fig.axes if ax.get_subplotspec() is not None]
    num_rows, num_columns = _grid(panels)
    fitting = max(1, int(WIDTH / (width / num_columns)))
    lines = math.ceil(num_columns / fitting)
    if lines > 1:
        columns = math.ceil(num_columns / lines)
        _say_what_is_shared(panels, num_columns, columns)
        grid = GridSpec(num_rows * lines, columns, figure=fig)
        for place, ax in enumerate(panels):
            row, column = divmod(place, num_columns)
            ax.set_subplotspec(grid[row * lines + column // columns, column % columns])
    fig.set_size_inches(WIDTH, height * lines)


def _grid(panels: list[Axes]) -> tuple[int, int]:
    """Rows and columns of panels that fill a grid, one in each place."""
    specs = [ax.get_subplotspec() for ax in panels]
    shapes = {spec.get_gridspec().get_geometry() for spec in specs}
    if len(shapes) == 1:
        [shape] = shapes
        if [spec.num1 for spec in specs] == list(range(math.prod(shape))):
            return shape
    return 1, 1


def _say_what_is_shared(panels: list[Axes], old: int, new: int) -> None:
    """What the first panel of a row, and the outer ones of a column, said for the others.

    ``old`` and ``new`` are numbers of columns.
    """
    for place, ax in enumerate(panels):
        column = place % old
        left, top, bottom = panels[place - column], panels[column], panels[column - old]
        ax.set_title(ax.get_title() or top.get_title(), fontsize=top.title.get_fontsize())
        ax.set_xlabel(ax.get_xlabel() or bottom.get_xlabel())
        ax.set_ylabel(ax.get_ylabel() or left.get_ylabel())
        ax.tick_params(labelbottom=True, labelleft=True)
    for place, ax in enumerate(panels):
        left = panels[place - place % old % new]
        if ax is not left and ax.get_shared_y_axes().joined(ax, left):
            ax.set_ylabel("" if ax.get_ylabel() == left.get_ylabel() else ax.get_ylabel())
            ax.tick_params(labelleft=False)
