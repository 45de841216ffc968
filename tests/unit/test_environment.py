"""What is installed: pinned with hashes, licensed, and the same in all the files that say so."""

import re
from pathlib import Path

import pytest

import licences

ROOT = Path(__file__).resolve().parents[2]
LOCKS = ROOT / "book" / "locks"
LOCKED = re.compile(r"([\w.-]+)==(\S+)(?: ; (.+))? \\$")


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def locked(name: str) -> dict[str, str]:
    """Package -> version in a file of locks, where every package has a hash."""
    versions = {}
    for block in re.split(r"\n(?=[\w])", "\n" + (LOCKS / name).read_text())[1:]:
        first, *hashes = block.rstrip().splitlines()
        package, version, _ = LOCKED.fullmatch(first).groups()
        assert hashes
        assert all(re.fullmatch(r" +--hash=sha256:[0-9a-f]{64}( \\)?", line) for line in hashes)
        versions[package] = version
    return versions


def pins() -> dict[str, str]:
    chosen, needed = licences.pinned()
    return chosen | needed


def test_locks_have_what_is_pinned():
    pinned = {normal(name): version for name, version in pins().items()}
    assert len(pinned) > 150
    packages, torch = locked("packages.txt"), locked("torch.txt")
    assert {name: (packages | torch).get(name) for name in pinned} == pinned
    assert locked("torch-cpu.txt") == {"torch": f"{pinned['torch']}+cpu"}
    assert locked("uv.txt") == {"uv": pinned["uv"]}
    assert "torch" not in packages
    assert {name: packages[name] for name in torch.keys() & packages.keys()} == {
        name: torch[name] for name in torch.keys() & packages.keys()
    }


def test_what_is_locked_and_not_pinned_is_for_other_systems():
    pinned = {normal(name) for name in pins()}
    lines = (LOCKS / "packages.txt").read_text().splitlines()
    found = [match.groups() for line in lines if (match := LOCKED.match(line))]
    assert {name for name, _, marker in found if not marker} <= pinned


@pytest.mark.parametrize("path", sorted(LOCKS.iterdir()), ids=lambda path: path.name)
def test_locks_name_no_place_to_fetch_from(path):
    assert not re.search(r"://|index-url|find-links", path.read_text())


def test_every_package_names_its_licence():
    found = {name: licences.licence(name) for name in pins()}
    assert all(re.search(r"\w", licence) for licence in found.values())
    table = licences.overview()
    assert all(text in table for text in ("| numpy |", "MathJax 3", "Font Awesome", "SIL OFL"))
    chosen, folded = table.split(":::{dropdown}")
    assert "| torch |" in chosen
    assert "| alabaster |" in folded


def test_package_without_a_licence_is_an_error(monkeypatch):
    from email.message import Message

    monkeypatch.setattr(licences, "metadata", lambda name: Message())
    with pytest.raises(ValueError, match="package = 'nothing': must name its licence"):
        licences.licence("nothing")


@pytest.mark.parametrize("path", sorted(ROOT.glob(".github/workflows/*.yml")), ids=lambda p: p.name)
def test_actions_are_pinned_by_commit(path):
    used = re.findall(r"uses: (.+)", path.read_text())
    assert used
    assert [u for u in used if not re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v[\d.]+", u)] == []
