"""Fixtures for all tests: the reference data beside the checkout, a browser, no leaked thread."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import threading
import time
from pathlib import Path

import pytest

# As the program sets it, before NumPy is imported: threads on small matrices wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


LONGEST = (
    # of the slow suite, by `make test-slow` with --durations; one that waits beside two that work
    "main_paths/test_live", "blind/test_score", "golden/test_golden", "docs/test_commands",
    "test_audit", "daemon/test_sessions", "cli/test_measure", "daemon/test_endurance",
    "discovery/test_movement", "discovery/test_years", "daemon/test_faults", "cli/test_outputs",
    "daemon/test_page_attacks",
    "analysis/test_running_series", "analysis/test_type_model", "output/test_pages",
    "cli/test_discover", "analysis/test_blind_prediction", "fleet/test_reprocess",
    "discovery/test_examination", "photogrammetry/test_ring_code", "test_properties",
    "discovery/test_grammar", "docs/test_site", "real_corners/test_real_corners",
    "cli/test_study_command", "photogrammetry/test_boards",
    # of the quick one, by the time of each file
    "daemon/test_lost", "api/test_api", "analysis/test_gauge",
    "output/test_dashboard", "main_paths/test_commands", "cli/test_commands",
    "photogrammetry/test_mount", "photogrammetry/test_series", "drivers/test_faults",
    "photogrammetry/test_common_interior", "drivers/test_serial_line",
    "analysis/test_thermal_model", "store/test_sense", "fleet/test_forward",
    "photogrammetry/test_measuring", "daemon/test_clock", "daemon/test_virtual_clock",
    "cli/test_thermal_commands", "store/test_database", "photogrammetry/test_survey",
    "daemon/test_gauge", "cli/test_testfield", "analysis/test_drift", "drivers/test_contract",
    "photogrammetry/test_network", "output/camera_files/test_camera_files", "drivers/test_android",
    "drivers/test_device_outputs", "fleet/test_stations", "api/test_live_camera",
    "output/test_testfield_print", "fleet/test_fleet", "daemon/test_camera_settings",
    "store/test_damage", "photogrammetry/test_long_series", "cli/test_wrong_usage",
    "simulation/test_outside_effect", "store/test_store_guard", "photogrammetry/test_tracking",
    "discovery/test_entries", "cli/test_import",
)  # fmt: skip
"""Files that take longest, in that order: so that no process is left alone with one at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Longest files first; the Makefile has pytest-xdist keep the order."""
    place = {f"{name}.py": number for number, name in enumerate(LONGEST)}
    folder = Path(__file__).parent
    items.sort(key=lambda i: place.get(str(i.path.relative_to(folder)), len(place)))


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Modules and tests stay to the end: the collector need not look at them again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
        gc.set_threshold(5000, 10, 50)


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


@pytest.fixture(scope="session")
def forker():
    """What starts daemons, with everything imported."""
    from tests.daemon.conftest import ENVIRONMENT
    from tests.daemon.forking import Forker

    forker = Forker(ENVIRONMENT)
    yield forker
    forker.close()


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


def watch(page, url: str) -> None:
    """Keep as `problems` what the page's console complains of and what leaves it from now on."""
    begun = hasattr(page, "problems")
    page.problems, page.own = [], (url, "data:", "blob:")
    if begun:
        return
    page.on("console", lambda m: m.type in ("error", "warning") and page.problems.append(m.text))
    page.on("pageerror", lambda e: page.problems.append(str(e)))
    page.on("request", lambda r: r.url.startswith(page.own) or page.problems.append(r.url))


@pytest.fixture
def page_of(browser):
    """(url, options) → its page, watched."""
    pages = []

    def open_(url: str, width: int = 1280, height: int = 900, **options):
        page = browser.new_page(viewport={"width": width, "height": height}, **options)
        page.set_default_timeout(120_000)  # ms: busy machines
        pages.append(page)
        watch(page, url)
        page.goto(url)
        return page

    yield open_
    for page in pages:
        page.close()


@pytest.fixture
def undrawn(monkeypatch):
    """Reports without their drawings, which take most of the time: where the words matter."""
    monkeypatch.setattr("thermocald.figures.Figure.svgs", lambda *_: [])


@pytest.fixture(autouse=True)
def no_leaked_secrets(monkeypatch):
    """What a test makes a secret stays in the texts of the next ones."""
    monkeypatch.setattr("thermocald.addresses._known", set())


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


@pytest.fixture
def mount():
    """Words of `mount` → mounted until the test ends; skips where nothing can be mounted."""
    mounted: list[Path] = []

    def mounts(*words: object) -> None:
        command = ["mount", *map(str, words)]
        if not shutil.which("mount") or subprocess.run(command, check=False).returncode:
            pytest.skip("nothing can be mounted here: needs root and tmpfs")
        mounted.append(words[-1])

    yield mounts
    for folder in reversed(mounted):
        subprocess.run(["umount", "-q", "-l", folder], check=False)


@pytest.fixture
def small_disk(tmp_path: Path, mount):
    """MB → the folder of a disk of this size."""

    def make(size_mb: int) -> Path:
        folder = tmp_path / "disk"
        folder.mkdir()
        mount("-t", "tmpfs", "-o", f"size={size_mb}m", "tmpfs", folder)
        return folder

    return make
