"""One browser and one visit of every page for all tests of the site."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from browse import FLAGS, PHONE, Server, Visit, new_context, visit
from playwright.sync_api import sync_playwright


@pytest.fixture(scope="session")
def browser():
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="session", params=["folder", "server"])
def address(request, built_site: Path):
    """Where the pages are: opened from the folder, and served."""
    if request.param == "folder":
        yield built_site.resolve().as_uri()
    else:
        with Server(built_site) as url:
            yield url


@pytest.fixture(scope="session")
def page_names(built_site: Path) -> list[str]:
    return sorted(path.name for path in built_site.glob("*.html"))


@pytest.fixture(scope="session")
def visits(browser, address: str, page_names: list[str]) -> dict[str, Visit]:
    """Every page on a wide screen."""
    with new_context(browser) as context:
        return {name: visit(context, f"{address}/{name}") for name in page_names}


@pytest.fixture(scope="session")
def phone_visits(browser, built_site: Path, page_names: list[str]) -> dict[str, Visit]:
    """Every page on a phone."""
    with new_context(browser, PHONE) as context:
        return {name: visit(context, f"{built_site.as_uri()}/{name}") for name in page_names}
