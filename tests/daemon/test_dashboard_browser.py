"""The page in a real browser beside a real daemon."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.daemon.test_page_attacks import free_port, serves

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
    daemon.until(lambda: serves(port))
    yield f"http://127.0.0.1:{port}/"
    if daemon.process.poll() is None:
        daemon.stop()
    assert "Traceback" not in daemon.log()  # a page was open when the daemon stopped


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
    reached = []
    for _ in range(12):
        phone.keyboard.press("Tab")
        focus = "document.activeElement.id || document.activeElement.className"
        reached.append(phone.evaluate(focus))
    assert reached[:2] == ["skip", "camera"]
    assert {"series", "download"} <= set(reached)


def test_a_page_that_dies_is_started_again_and_says_when_acquisition_ended(daemon, shown, page_of):
    children = Path(f"/proc/{daemon.process.pid}/task/{daemon.process.pid}/children")
    os.kill(int(children.read_text()), signal.SIGKILL)
    daemon.until(lambda: "it is started again" in daemon.log())
    daemon.more(2)
    daemon.until(lambda: serves(int(shown.split(":")[2][:-1])))
    page = page_of(shown)
    page.wait_for_function("() => document.querySelector('#figures dd') !== null")
    daemon.stop()
    page.wait_for_function(
        "() => document.querySelector('#connection').textContent"
        ".startsWith('acquisition has stopped: no daemon has run since 20')"
    )
    assert "stored data are shown below" in page.text_content("#state")


@pytest.mark.parametrize(
    ("series", "state", "note"),
    [(None, "idle until a session begins", "no epoch of camera one is stored yet"),
     ("", "this daemon has no camera; its thermometers are listed under Devices",
      "there is no series yet")],
)  # fmt: skip
def test_without_an_epoch_it_says_why(daemon, devices, page_of, series, state, note):
    port = free_port()
    sections = devices(period_s=1.0, series=series)
    if series == "":
        sections["cameras"] = []
    daemon.run(**sections, dashboard={"enabled": True, "port": port})
    daemon.until(lambda: serves(port))
    page = page_of(f"http://127.0.0.1:{port}/")
    page.wait_for_function("() => document.querySelector('#course-note').textContent !== ''")
    assert page.text_content("#state") == state
    assert page.text_content("#course-note") == note
    assert "housing" in page.text_content("#devices")
    assert daemon.stop() == 0
