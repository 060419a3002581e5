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
  .filter(p => (p.getAttribute('d') || '').length > 20 && p.getBBox().width > 0).length >= 5"""
_FIGURES = "() => document.querySelector('#figures dd') !== null"


@pytest.fixture
def page(daemon):
    """Sections → the address of the page of a daemon that runs with them."""

    def start(**sections) -> str:
        port = free_port()
        daemon.run(**sections, dashboard={"enabled": True, "port": port})
        daemon.until(lambda: serves(port))
        return f"http://127.0.0.1:{port}/"

    yield start
    if daemon.process.poll() is None:
        daemon.stop()
    assert "Traceback" not in daemon.log()  # a page was open when the daemon stopped


@pytest.fixture
def shown(daemon, devices, page):
    """The address of the page of a daemon with epochs."""
    # slow enough for a busy machine: a deferred epoch is calibrated later and not drawn
    address = page(**devices(period_s=1.5))
    daemon.more(3)
    return address


def test_it_is_live_on_desk_and_phone_light_and_dark(shown, page_of):
    desk = page_of(shown)
    desk.wait_for_function(_FIGURES)
    epoch = int(desk.text_content("#figures dd").split()[0])
    desk.wait_for_function(
        f"() => parseInt(document.querySelector('#figures dd').textContent) > {epoch + 2}"
    )
    assert desk.text_content("#connection") == "live"
    for what in ("circle", "line"):
        desk.wait_for_function(f"() => document.querySelectorAll('#overlay {what}').length > 40")
    desk.wait_for_function("() => document.querySelector('#frame').naturalWidth > 300")
    desk.wait_for_function(_DRAWN)
    for span in ("86400", ""):
        desk.check(f'input[name=span][value="{span}"]')
        desk.wait_for_function(_DRAWN)
    assert "started" in desk.text_content("#events")
    assert "housing" in desk.text_content("#devices")
    assert desk.evaluate(_UNLABELLED) == []
    assert desk.get_attribute("html", "lang") == "en"
    phone = page_of(shown, width=390, color_scheme="dark")
    phone.wait_for_function(_FIGURES)
    phone.wait_for_function(_DRAWN)
    assert not phone.evaluate(_WIDER)
    light, dark = (
        one.evaluate("getComputedStyle(document.body).backgroundColor") for one in (desk, phone)
    )
    assert dark != light
    assert desk.problems == phone.problems == []
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
    page.wait_for_function(_FIGURES)
    daemon.stop()
    page.wait_for_function(
        "() => document.querySelector('#connection').textContent"
        ".startsWith('acquisition has stopped: no daemon has run since 20')"
    )
    assert "stored data are shown below" in page.text_content("#state")


@pytest.mark.parametrize(
    ("cameras", "state", "note"),
    [(1, "idle until a session begins", "no epoch of camera one is stored yet"),
     (0, "this daemon has no camera; its thermometers are listed under Devices",
      "there is no series yet")],
)  # fmt: skip
def test_without_an_epoch_it_says_why(devices, page, page_of, cameras, state, note):
    sections = devices(period_s=1.0, series=None)
    sections["cameras"] = sections["cameras"][:cameras]
    shown = page_of(page(**sections))
    shown.wait_for_function("() => document.querySelector('#course-note').textContent !== ''")
    assert shown.text_content("#state") == state
    assert shown.text_content("#course-note") == note
    assert "housing" in shown.text_content("#devices")
