"""The page in a real browser, with several cameras: all of it shows the chosen one."""

from __future__ import annotations

import json
import os

import pytest

from tests.output.test_dashboard import DEVICE, add_series, start_page, status_of
from tests.output.test_pages import FAULTS, keep
from thermocald.daemon.live_state import status_warnings

# c of camera k is k mm, which identifies the camera of a value
_SHOWN = """() => ({
  selected: document.querySelector('#camera').value,
  figure: Number([...document.querySelectorAll('#figures dt')].find(e => e.textContent === 'c')
    .nextElementSibling.textContent.split(' ')[0]),
  curve: document.querySelector('#course').data.find(t => t.name === 'c').y[0],
  note: document.querySelector('#course-note').textContent.split('/')[0],
  csv: new URL(document.querySelector('#download').href).searchParams.get('camera'),
  targets: document.querySelectorAll('#overlay circle').length,
})"""
_HIDDEN = """() => { const table = document.querySelector('.scroll:has(#devices)');
  return table.scrollHeight - table.clientHeight; }"""
_RIGHT = """chosen => [...document.querySelectorAll(chosen)]
  .map(e => e.getBoundingClientRect().right)"""
_SETTLED = """name => document.querySelector('#course-note').textContent.startsWith(name + '/')
  && document.querySelector('#frame-caption').textContent.startsWith('epoch')"""


def _name(k: int) -> str:
    return f"{'a-camera-of-a-long-name-' * 4}{k:02}"  # as a recording may have


@pytest.fixture
def page_with(tmp_path):
    """Map a number of cameras to a page's address and a call that makes the daemon run."""
    servers = []

    def serve(cameras: int):
        path, live, parts = tmp_path / "t.db", tmp_path / "live", {}
        live.mkdir()
        for k in range(1, cameras + 1):
            times = [1.6e9 + 10 * n for n in range(1, 31)]
            add_series(path, _name(k), times, [k] * 30, (640, 480))
            last = {"epoch": 30, "frame_time": 1.6e9 + 300, "temperature": 50.0, "c": float(k),
                    "sigma0": 1.0, "n_observations": k, "n_rejected": 0, "status": "ok",
                    "state": "ready"}  # fmt: skip
            counts = dict.fromkeys(("late_p99_s", "skipped", "lost", "deferred", "caught_up"), 0)
            parts[_name(k)] = {**counts, "last": last}
            targets = {"x": [9.0] * k, "y": [9.0] * k, "vx": [0.1] * k, "vy": [0.1] * k,
                       "rejected": [False] * k}  # fmt: skip
            shown = {"row": {"epoch": 30}, "targets": targets}
            (live / f"{_name(k)}.json").write_text(json.dumps(shown))
        server, port = start_page(path, live)
        servers.append(server)

        def start() -> None:
            mqtt = {**DEVICE, "device": "out", "why": "no broker", "since": 1.6e9}
            status = status_of(path, parts, outputs={"mqtt": mqtt})
            status["store"] |= {"lost": 2, "lost_why": "the disk was full"}
            document = {**status, "warnings": status_warnings(status)}
            (live / "status.json").write_text(json.dumps(document))

        return f"http://127.0.0.1:{port}/", start

    yield serve
    for server in servers:
        server.kill()
        server.communicate()


@pytest.mark.parametrize("cameras", [2, pytest.param(12, marks=pytest.mark.slow)])
def test_the_chosen_camera_rules_the_whole_page(cameras, page_with, page_of):
    url, start = page_with(cameras)
    page = page_of(url)
    # the curves are shown before the daemon has reported its cameras
    page.wait_for_function("() => (document.querySelector('#course').data || []).length")
    start()
    page.wait_for_function("() => document.querySelector('#figures dd') !== null")
    page.wait_for_function(_SETTLED, arg=page.input_value("#camera"))
    first = int(page.input_value("#camera")[-2:])
    assert page.evaluate(_SHOWN) == _all_of(first)

    box = page.locator("#course .modebar").bounding_box()
    curves = page.locator('#course .nsewdrag[data-subplot="xy"]').bounding_box()
    assert box["y"] + box["height"] <= curves["y"] + 1  # the toolbar covers no curve
    right = page.evaluate(_RIGHT, "section")
    assert max(right) - min(r for r in right if r > 800) < 1  # the whole width is used
    keep(page, f"dashboard-{cameras}-1280")
    page.set_viewport_size({"width": 390, "height": 900})
    page.wait_for_timeout(500)  # the curves are drawn anew
    assert page.evaluate(FAULTS["wider"]) == []
    assert page.evaluate(_HIDDEN) == 0  # a device's reason is within its card
    keep(page, f"dashboard-{cameras}-390")
    page.set_viewport_size({"width": 703, "height": 1000})  # A4 less margins
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    page.wait_for_timeout(500)
    (curves,), (card,) = (page.evaluate(_RIGHT, s) for s in ("#course .main-svg", "section.wide"))
    assert curves <= card <= 703  # on paper, the curves keep to their card
    assert page.locator("#camera").is_visible()
    assert page.locator(".modebar:visible, #series:visible").count() == 0
    keep(page, f"dashboard-{cameras}-a4")
    page.emulate_media(media="screen")
    page.set_viewport_size({"width": 1280, "height": 900})

    # answers for cameras that are no longer chosen arrive late
    slow, wanted = (_name(1), _name(cameras)) if first != 1 else (_name(cameras), _name(1))
    page.evaluate(
        """slow => { const get = window.fetch; window.fetch = async (path, ...more) => {
        if (path.includes(slow)) await new Promise(done => setTimeout(done, 600));
        return get(path, ...more); }; }""",
        slow,
    )
    for name in (slow, wanted, slow, wanted):
        page.select_option("#camera", name)
    page.wait_for_function(_SETTLED, arg=wanted)
    page.wait_for_timeout(1000)
    assert page.evaluate(_SHOWN) == _all_of(int(wanted[-2:]))
    assert "out since 2020-09-13 12:26:40 UTC: no broker" in page.text_content("#devices")
    warned = "2 epochs lost, taken but not stored: the disk was full"
    assert page.text_content("#warnings") == f"{warned}\noutput mqtt: no broker"
    assert "ready; every 10 s" in page.text_content("#devices")  # of every camera, not one alone


def test_the_page_of_a_silent_daemon_says_so_and_its_times_are_utc(page_with, page_of, tmp_path):
    """A killed daemon's page said "live" for ever; the curves were drawn in local time."""
    url, start = page_with(2)
    start()
    page = page_of(url, timezone_id="Asia/Tokyo")
    page.wait_for_function(_SETTLED, arg=_name(1))  # always the first camera
    assert page.text_content("#connection") == "live"
    assert page.get_attribute("#overlay", "viewBox") == "0 0 640 480"  # of the first frame shown
    first = page.evaluate("document.querySelector('#course').data[0].x[0]")
    assert first == "2020-09-13T12:26:50.000"
    os.utime(tmp_path / "live/status.json", (1.6e9, 1.6e9))
    page.wait_for_function(
        "() => document.querySelector('#state').textContent.startsWith("
        "'the daemon has not answered since 2020-09-13 12:26:40 UTC')"
    )


def _all_of(k: int) -> dict:
    return {
        "selected": _name(k), "figure": k, "curve": k, "note": _name(k), "csv": _name(k),
        "targets": k,
    }  # fmt: skip


def test_without_javascript_the_page_says_only_that_it_needs_it(page_with, page_of):
    """It said "connecting …" and "no epoch yet" for ever."""
    url, _ = page_with(1)
    page = page_of(url, 390, java_script_enabled=False)
    shown = page.locator("body").inner_text().split("\n")
    assert [line for line in shown if line.strip()] == [
        "thermocald",
        "The page needs JavaScript; thermocald status shows the status in a terminal.",
    ]
