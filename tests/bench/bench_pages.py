"""How long a reader waits: pages of a built site in Chromium on a processor slowed down four times.

    python tests/bench/bench_pages.py book/_build/html

prints for every page, as the median of some loads from the folder, the seconds until its largest
part is painted (LCP) and until its last equation stands there.
"""

from __future__ import annotations

import shutil
import statistics
import sys
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

SLOWER, LOADS = 4, 3
# MathJax, where a site still has it, says when it is done; else equations come with the page.
TIMES = """async () => {
  const painted = await new Promise(resolve => {
    new PerformanceObserver(list => resolve(list.getEntries().at(-1).startTime))
      .observe({type: "largest-contentful-paint", buffered: true});
    setTimeout(() => resolve(0), 10000);
  });
  const [navigation] = performance.getEntriesByType("navigation");
  const promise = window.MathJax?.startup?.promise;
  if (promise) await promise;
  const equations = promise ? performance.now() : navigation.domInteractive;
  return [painted / 1000, equations / 1000];
}"""


def times(browser: Browser, address: str) -> tuple[float, float]:
    """Seconds until the largest part and until the equations of a page."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.set_default_timeout(120_000)
    client = page.context.new_cdp_session(page)
    client.send("Emulation.setCPUThrottlingRate", {"rate": SLOWER})
    page.goto(address, wait_until="load")
    painted, equations = page.evaluate(TIMES)
    page.close()
    return painted, equations


def main() -> None:
    folder = Path(sys.argv[1]).resolve()
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        # Not the index, which only leads to the first page.
        for path in sorted({*folder.glob("*.html")} - {folder / "index.html"}):
            runs = [times(browser, path.as_uri()) for _ in range(LOADS)]
            painted, equations = map(statistics.median, zip(*runs, strict=True))
            print(f"{path.name:24} LCP {painted:5.2f} s  equations {equations:6.2f} s")
        browser.close()


if __name__ == "__main__":
    main()
