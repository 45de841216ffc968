"""An interactive figure as HTML: its data, its scripts, and a picture where there are none."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
from IPython.display import HTML
from matplotlib.figure import Figure

MOST = 300_000  # characters of data: a page is to load fast


def figure(name: str, data: Mapping[str, Any], fig: Figure, alt: str) -> HTML:
    """The figure whose script is ``book/extra/NAME.js``; a page has at most one.

    The data stand in the page, since a page that is opened from a folder may fetch nothing. The
    scripts put the figure in the place of the picture.

    Args:
        name: of the element and of its script.
        data: what the script shows, as JSON has it.
        fig: what it shows first, for readers without scripts; it is closed.
        alt: the same in words.

    Raises:
        ValueError: data with NaN or infinite numbers, or too many of them.
    """
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    if len(text) > MOST:
        raise ValueError(f"data of {name}: {len(text)} characters, must be at most {MOST}")
    text = text.replace("</", "<\\/")  # or it could end its element
    return HTML(
        f'<link rel="stylesheet" href="interactive.css">\n'
        f'<div id="{name}" class="interactive">\n'
        f'<img alt="{html.escape(alt)}" src="{_address(fig)}">\n'
        f'<script type="application/json">{text}</script>\n'
        f"</div>\n"
        f'<script src="interactive.js"></script>\n'
        f'<script src="{name}.js"></script>'
    )


def _address(fig: Figure) -> str:
    """The figure as an address of an image; the figure itself is not shown."""
    picture = io.BytesIO()
    fig.savefig(picture, format="png", dpi=80)
    plt.close(fig)
    return f"data:image/png;base64,{base64.b64encode(picture.getvalue()).decode()}"
