"""Fixtures for all tests: the reference data beside the checkout, a browser, no leaked thread."""

from __future__ import annotations

import os
import shutil
import threading
import time
from pathlib import Path

import pytest

# As the program sets it, before NumPy is imported: threads on small matrices wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real data beside the checkout; skips where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not (folder / "data").is_dir():
        pytest.skip(f"the reference data are absent: {folder / 'data'} does not exist")
    return folder


_QUIET = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium; skips where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with sync_api.sync_playwright() as play:
        opened = play.chromium.launch(executable_path=path, args=_QUIET)
        yield opened
        opened.close()


@pytest.fixture
def page_of(browser):
    """(url, options) → its page; what the console complains of and what leaves it is `problems`."""
    pages = []

    def open_(url: str, width: int = 1280, height: int = 900, **options):
        page = browser.new_page(viewport={"width": width, "height": height}, **options)
        pages.append(page)
        page.problems = []
        page.on(
            "console", lambda m: m.type in ("error", "warning") and page.problems.append(m.text)
        )
        page.on("pageerror", lambda e: page.problems.append(str(e)))
        page.on(
            "request",
            lambda r: not r.url.startswith((url, "data:", "blob:")) and page.problems.append(r.url),
        )
        page.goto(url)
        return page

    yield open_
    for page in pages:
        page.close()


@pytest.fixture(autouse=True)
def no_leaked_threads():
    """A thread that outlives its test fails it."""
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 2.0
    while leaked := [t for t in threading.enumerate() if t not in before and t.is_alive()]:
        if time.monotonic() > deadline:
            pytest.fail(f"threads outlive the test: {[t.name for t in leaked]}")
        time.sleep(0.01)
