"""The hash of source code: what changes it, and what does not."""

import pytest

import sources
from sources import imported_modules, source_hash

SOURCES = {
    "costs": '''"""Costs."""

from ipo.solvers import solve


def cost(x, scale=2):
    """What x costs."""
    # twice
    return scale * solve(x)


class Oracle:
    """Knows the answer."""

    name = "#1"
''',
    "solvers": "from ipo import limits\n\n\ndef solve(x):\n    return min(x, limits.LARGEST)\n",
    "limits": "LARGEST = 10\n",
    "unrelated": "import ipo.costs\n",
}


@pytest.fixture(autouse=True)
def package(tmp_path, monkeypatch):
    """A toy package in the place of ``ipo``."""
    for name, source in SOURCES.items():
        (tmp_path / f"{name}.py").write_text(source)
    (tmp_path / "worlds").mkdir()
    (tmp_path / "worlds" / "__init__.py").write_text("")
    (tmp_path / "worlds" / "door.py").write_text("from ipo import limits\n")
    monkeypatch.setattr(sources, "PACKAGES", {"ipo": tmp_path})
    return tmp_path


def hash_after(package, name: str, old: str, new: str) -> tuple[str, str]:
    """The hash of ``costs`` before and after an edit of a module."""
    before = source_hash(["ipo.costs"])
    path = package / f"{name}.py"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    return before, source_hash(["ipo.costs"])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# twice", "# two times"),
        ("    # twice\n", ""),
        ("solve(x)\n", "solve(x)  # a comment at the end\n"),
        ('"""Costs."""', '"""Costs of things,\n\nin many lines."""'),
        ('    """What x costs."""\n', ""),
        ('"""Knows the answer."""', '"""Knows the question."""'),
        ("\n\n\n", "\n"),
        ("solve(x)\n", "solve(x)   \n"),
    ],
)
def test_explanations_and_blank_space_do_not_count(package, old, new):
    before, after = hash_after(package, "costs", old, new)
    assert before == after


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("scale=2", "scale=3"),
        ("scale *", "scale +"),
        ('"#1"', '"#2"'),  # a string, not a comment
        ("    return scale * solve(x)", "    if x:\n        return scale * solve(x)"),
        ("def cost", "def price"),
        ("class Oracle:", "class Oracle(dict):"),
    ],
)
def test_code_counts(package, old, new):
    before, after = hash_after(package, "costs", old, new)
    assert before != after


@pytest.mark.parametrize(
    ("name", "old", "new"), [("solvers", "min", "max"), ("limits", "10", "11")]
)
def test_imported_modules_count_at_any_distance(package, name, old, new):
    before, after = hash_after(package, name, old, new)
    assert before != after


def test_other_modules_do_not_count(package):
    before, after = hash_after(package, "unrelated", "import", "import os, ")
    assert before == after


def test_modules_that_import_each_other_can_be_hashed(package):
    before, after = hash_after(package, "limits", "10", "10\nimport ipo.costs")
    assert before != after


def test_order_and_repetition_of_names_do_not_count():
    assert source_hash(["ipo.limits", "ipo.unrelated"]) == source_hash(
        ["ipo.unrelated", "ipo.limits", "ipo.costs"]
    )


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("from ipo import costs, limits", {"ipo.costs", "ipo.limits"}),
        ("from ipo import costs as c", {"ipo.costs"}),
        ("from ipo.costs import cost", {"ipo.costs"}),
        ("import ipo.costs", {"ipo.costs"}),
        ("import ipo.costs as c, os.path", {"ipo.costs"}),
        ("def late():\n    from ipo.costs import cost", {"ipo.costs"}),
        ("from ipo import __version__", set()),
        ("from ipo.worlds import door", {"ipo.worlds", "ipo.worlds.door"}),
        ("from ipo.worlds.door import Door", {"ipo.worlds.door"}),
        ("import numpy\nfrom scipy import limits\nimport ipolite.costs", set()),
        ("text = 'from ipo import costs'", set()),
    ],
)
def test_imports_are_found(code, expected):
    assert imported_modules(code) == expected
