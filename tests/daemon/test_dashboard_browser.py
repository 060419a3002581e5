"""The page in a real browser beside a real daemon."""

from __future__ import annotations

import os
import signal
import socket

import pytest

from tests.daemon.test_page_attacks import free_port

pytestmark = pytest.mark.slow

_UNLABELLED = """() => [...document.querySelectorAll('a, button, select, input, [tabindex="0"]')]
  .filter(e => e.offsetParent !== null && !e.closest('.js-plotly-plot'))
  .filter(e => !(e.textContent.trim() || e.getAttribute('aria-label')
    || e.getAttribute('aria-labelledby') || (e.labels && e.labels.length)))
  .map(e => e.outerHTML)"""
_WIDER = "() => document.documentElement.scrollWidth > document.documentElement.clientWidth + 1"
_DRAWN = """() => [...document.querySelectorAll('#course .scatterlayer path.js-line')]
  .filter(p => (p.getAttribute('d') || '').length > 20 && p.getBBox().width > 0).length"""


@pytest.fixture
def shown(daemon, devices):
    """The address of a running daemon's page."""
    port = free_port()
    # slow enough for a busy machine: a deferred epoch is calibrated later and not drawn
    daemon.run(**devices(period_s=1.5), dashboard={"enabled": True, "port": port})
    daemon.more(3)
    daemon.until(lambda: _listens(port))
    yield f"http://127.0.0.1:{port}/"
    if daemon.process.poll() is None:
        daemon.stop()
    assert "Traceback" not in daemon.log()  # a page was open when the daemon stopped


def _listens(port: int) -> bool:
    with socket.socket() as attempt:
        return attempt.connect_ex(("127.0.0.1", port)) == 0


def test_it_is_live_on_desk_and_phone_light_and_dark(daemon, shown, page_of):
    page = page_of(shown)
    page.wait_for_function("() => document.querySelector('#figures dd') !== null")
    epoch = int(page.text_content("#figures dd").split()[0])
    page.wait_for_function(
        f"() => parseInt(document.querySelector('#figures dd').textContent) > {epoch + 2}"
    )
    assert page.text_content("#connection") == "live"
    page.wait_for_function("() => document.querySelectorAll('#overlay circle').length > 40")
    page.wait_for_function("() => document.querySelectorAll('#overlay line').length > 40")
    page.wait_for_function("() => document.querySelector('#frame').naturalWidth > 300")
    page.wait_for_function(f"() => ({_DRAWN})() >= 5")
    for span in ("86400", ""):
        page.check(f'input[name=span][value="{span}"]')
        page.wait_for_function(f"() => ({_DRAWN})() >= 5")
    assert "started" in page.text_content("#events")
    assert "housing" in page.text_content("#devices")
    assert page.evaluate(_UNLABELLED) == []
    assert page.get_attribute("html", "lang") == "en"
    light = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert page.problems == []

    phone = page_of(shown, width=390, color_scheme="dark")
    phone.wait_for_function("() => document.querySelector('#figures dd') !== null")
    phone.wait_for_function(f"() => ({_DRAWN})() >= 5")
    assert not phone.evaluate(_WIDER)
    assert phone.evaluate("getComputedStyle(document.body).backgroundColor") != light
    assert phone.problems == []


def test_the_keyboard_reaches_everything(shown, page_of):
    page = page_of(shown)
    page.wait_for_function("() => document.querySelector('#figures dd') !== null")
    page.wait_for_function("() => document.querySelector('#series').options.length > 0")
    reached = []
    for _ in range(12):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate("document.activeElement.id || document.activeElement.className")
        )
    assert reached[:2] == ["skip", "camera"]
    assert {"series", "download"} <= set(reached)


def test_the_death_of_the_page_does_not_touch_acquisition(daemon, shown):
    children = f"/proc/{daemon.process.pid}/task/{daemon.process.pid}/children"
    with open(children) as file:
        (child,) = [int(pid) for pid in file.read().split()]
    before = daemon.results()[-1]["epoch"]
    os.kill(child, signal.SIGKILL)
    daemon.until(lambda: daemon.results()[-1]["epoch"] > before + 5)
    daemon.until(lambda: "it is started again" in daemon.log())
    numbers = [result["epoch"] for result in daemon.results()]
    assert numbers == list(range(1, len(numbers) + 1))


def test_a_page_that_is_open_says_when_acquisition_ended(daemon, shown, page_of):
    page = page_of(shown)
    page.wait_for_function("() => document.querySelector('#figures dd') !== null")
    daemon.stop()
    page.wait_for_function(
        "() => document.querySelector('#connection').textContent"
        ".startsWith('acquisition has stopped: no daemon has run since 20')"
    )
    assert "stored data are shown below" in page.text_content("#state")
