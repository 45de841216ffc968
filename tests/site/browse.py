"""Opens pages in Chromium and notes what a reader would meet, for the tests of the site."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from urllib.parse import urlsplit

from playwright.sync_api import Browser, BrowserContext, Page

FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
WIDE = {"width": 1440, "height": 900}
PHONE = {"width": 390, "height": 844}

# Everything that the tests want to know of a page, in one round trip.
CONTENT = """async () => {
  const all = (selector) => [...document.querySelectorAll(selector)];
  const pictures = all('img').filter(picture => picture.checkVisibility());
  pictures.forEach(picture => { picture.loading = 'eager'; });  // the others are for another theme
  await Promise.allSettled(pictures.map(picture => picture.decode()));
  // What is left of the TeX of an equation: the build takes away what it has set.
  const source = (math) => [...math.childNodes]
    .filter(node => node.nodeType === Node.TEXT_NODE).map(node => node.data).join('');
  return {
    links: all('a[href]').map(a => a.href),
    ids: all('[id]').map(e => e.id),
    images: pictures.map(i => ({
      source: i.getAttribute('src'), alt: i.alt, loaded: i.complete && i.naturalWidth > 0})),
    math: all('.math').length,
    unrendered: all('.math')
      .filter(m => !m.querySelector('mjx-container') || source(m).match(/\\\\[(\\[]/))
      .map(m => m.textContent.slice(0, 200)),
    equations: all('mjx-container').length,
    // Mathematics that was not read as such.
    dollars: all('.bd-article :is(p, li, td, dd, figcaption)')
      .flatMap(e => [...e.childNodes])
      .filter(node => node.nodeType === Node.TEXT_NODE && node.data.includes('$'))
      .map(node => node.data.slice(0, 200)),
    math_errors: all('[data-mml-node="merror"], mjx-merror').map(m => m.outerHTML.slice(0, 200)),
    figures: all('.bd-article figure').map(f => ({
      number: f.querySelector('.caption-number')?.innerText.trim() ?? '',
      caption: f.querySelector('.caption-text')?.innerText.trim() ?? ''})),
    width: document.documentElement.scrollWidth,
  };
}"""
# Displayed equations that a narrow screen shrinks below two thirds.
SHRUNK = """() => [...document.querySelectorAll('.bd-article mjx-container[display] > svg')]
  .filter(svg => svg.checkVisibility())
  .map(svg => {
    const inEx = parseFloat(svg.getAttribute('width'));
    const probe = svg.cloneNode();
    Object.assign(probe.style, {width: '1ex', height: '1ex', position: 'absolute'});
    svg.parentNode.append(probe);
    const natural = inEx * probe.getBoundingClientRect().width;
    probe.remove();
    const scale = svg.getBoundingClientRect().width / natural;
    return {scale, tex: svg.parentNode.innerText.slice(0, 60)};
  })
  .filter(equation => equation.scale < 0.66)"""
# Pixels for each point of a figure's width, by figure; all have been loaded.
SCALES = """() => [...document.querySelectorAll('.picture img')]
  .filter(picture => picture.checkVisibility())
  .map(picture => ({
    scale: picture.clientWidth / (.75 * picture.naturalWidth), alt: picture.alt.slice(0, 60)}))"""
# Tables that are wider than the box in which they stand, folded ones, too: opens all folds.
WIDE_TABLES = """() => {
  document.querySelectorAll('.bd-article details').forEach(fold => { fold.open = true; });
  const boxes = (e) => e.matches('.bd-article') ? [] : [e, ...boxes(e.parentElement)];
  return [...document.querySelectorAll('.bd-article table')]
    .filter(table => boxes(table).some(box => box.scrollWidth > box.clientWidth + 1))
    .map(table => table.innerText.slice(0, 60));
}"""


@dataclass
class Visit:
    """What happened while a page loaded, and what is on it."""

    url: str
    requests: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    content: dict = field(default_factory=dict)

    def external_requests(self) -> list[str]:
        """Requests that leave the folder or the server that the page itself came from."""
        home = urlsplit(self.url)
        return [
            url
            for url in self.requests
            if urlsplit(url).scheme not in ("data", "blob")
            and (urlsplit(url).scheme, urlsplit(url).netloc) != (home.scheme, home.netloc)
        ]


def new_context(browser: Browser, viewport: dict = WIDE) -> BrowserContext:
    context = browser.new_context(viewport=viewport)
    context.set_default_timeout(20_000)
    return context


def visit(context: BrowserContext, url: str) -> Visit:
    """Open a page and note everything."""
    seen, page = Visit(url), context.new_page()
    page.on("request", lambda request: seen.requests.append(request.url))
    page.on("requestfailed", lambda request: seen.failures.append(request.url))
    page.on("response", lambda response: note_status(seen, response))
    page.on("pageerror", lambda error: seen.errors.append(str(error)))
    page.on("console", lambda message: note_console(seen, message))
    open_page(page, url)
    seen.content = page.evaluate(CONTENT) | {
        "shrunk": page.evaluate(SHRUNK),
        "scales": page.evaluate(SCALES),
        "wide_tables": page.evaluate(WIDE_TABLES),
    }
    page.close()
    return seen


def open_page(page: Page, url: str) -> None:
    page.goto(url, wait_until="load")
    # The first page of the folder redirects at once.
    page.wait_for_function("document.readyState === 'complete' && document.title !== ''")


def note_status(seen: Visit, response) -> None:
    if response.status >= 400:
        seen.failures.append(f"{response.status} {response.url}")


def note_console(seen: Visit, message) -> None:
    if message.type in ("error", "warning"):
        seen.errors.append(message.text)


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *arguments) -> None:
        """Says nothing: the tests look at the browser's side."""


class Server:
    """The site on localhost, for as long as the ``with`` block lasts."""

    def __init__(self, folder: Path):
        handler = partial(QuietHandler, directory=str(folder))
        self._server = ThreadingHTTPServer(("localhost", 0), handler)
        self.url = f"http://localhost:{self._server.server_port}"

    def __enter__(self) -> str:
        Thread(target=self._server.serve_forever, daemon=True).start()
        return self.url

    def __exit__(self, *error) -> None:
        self._server.shutdown()
        self._server.server_close()
