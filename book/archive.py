"""The source of the book as an archive that the site offers, and where else it is."""

from __future__ import annotations

import zipfile
from pathlib import Path

import yaml

NAME = "book-source.zip"
INSIDE = "book-source"  # the folder that the archive has
PARTS = (
    *("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "Makefile", "README.md"),
    *("_config.yml", "_toc.yml", "environment.txt", "pyproject.toml"),
    *("book", "data", "ipo", "notebooks", "tests"),
)
# What programs leave beside the sources, ...
WASTE = ("__pycache__", "_build", "_executed", "reproduced", "tabulated", "checkpoints")
WASTE_ENDINGS = (".tmp", ".lock", ".egg-info")
# ... and what knows the solutions of coding exercises.
SOLUTIONS = ("notebooks/exercises", "tests/teaching")
DATE = (2020, 1, 1, 0, 0, 0)  # so that the same files make the same archive


def write_archive(root: Path, target: Path, packages: Path) -> None:
    """Everything that builds the book, without solutions of coding exercises.

    What is made of those for students, in the folder ``packages``, comes along in their place.
    """
    files = {path.relative_to(root): path for path in sources(root)}
    files |= {Path("book", packages.name, path.name): path for path in packages.glob("*.zip")}
    target.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(target, "w") as archive:
        for name, path in sorted(files.items()):
            entry = zipfile.ZipInfo(f"{INSIDE}/{name.as_posix()}", DATE)
            entry.external_attr = 0o644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, path.read_bytes(), compresslevel=6)


def sources(root: Path) -> list[Path]:
    """All files that belong into the archive."""
    found = []
    for part in (root / name for name in PARTS):
        found += [part] if part.is_file() else part.rglob("*")
    return sorted(path for path in found if path.is_file() and belongs(path.relative_to(root)))


def belongs(path: Path) -> bool:
    """Whether somebody wrote it, and a student may read it."""
    is_waste = any(
        part in WASTE or part.endswith(WASTE_ENDINGS) or part.startswith(".") for part in path.parts
    )
    return not is_waste and not any(path.is_relative_to(folder) for folder in SOLUTIONS)


def where_to_find_it(root: Path, archive: Path) -> str:
    """Links to the archive, and to the repository where `_config.yml` names one."""
    size = archive.stat().st_size / 2**20
    config = yaml.safe_load((root / "_config.yml").read_text(encoding="utf-8"))
    address = config.get("repository", {}).get("url")
    return (
        f'The source of the whole book, with its data: <a href="{NAME}" download>{NAME}</a> '
        f"({size:.0f} MB)" + (f", or [{address}]({address})" if address else "") + ".\n"
    )
