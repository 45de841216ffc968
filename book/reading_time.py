"""How long a chapter takes: to read, by its words, and to run, by the record of this build."""

from __future__ import annotations

import re
from pathlib import Path

from nbformat import NotebookNode

from chapters import Notebook
from fragments import write_fragment

WORDS_PER_MINUTE = 220
# Blocks of code and of equations, whose time no count of words can say, and lines of directives.
NO_WORDS = re.compile(r"^(`{3,}).*?^\1\s*$|\$\$.*?\$\$|^:{3,}.*?$|^:[\w-]+:.*?$", re.S | re.M)
INLINE = re.compile(r"\$[^$]+\$|\{[\w:+-]+\}`[^`]*`|`[^`]*`")  # read as one word each


def write_fragments(folder: Path, notebooks: list[Notebook]) -> None:
    """Writes ``_generated/times/`` under ``folder``: a line for each chapter, a table of all."""
    table = ["| chapter | words | minutes to read | seconds to run |", "|:--|--:|--:|--:|"]
    for notebook in notebooks:
        words, seconds = count_words(notebook.read()), notebook.read_record()["seconds"]
        line = (
            f"**Time:** about {minutes(words)} minutes to read ({words:,} words, without code, "
            "equations and exercises); "
            f"its notebook ran in {seconds:.0f} seconds when this site was built.\n"
        )
        write_fragment(folder, f"times/{notebook.name}", line)
        row = [f"{{doc}}`{notebook.name}`", f"{words:,}", f"{minutes(words)}", f"{seconds:.0f}"]
        table.append(f"| {' | '.join(row)} |")
    write_fragment(folder, "times/all", "\n".join(table) + "\n")


def count_words(notebook: NotebookNode) -> int:
    """Words of its prose: an equation, a number that is glued and a name in code are one each."""
    prose = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    return len(re.findall(r"[^\W_][\w'’-]*", INLINE.sub(" x ", NO_WORDS.sub(" ", prose))))


def minutes(words: int) -> int:
    return max(1, round(words / WORDS_PER_MINUTE))
