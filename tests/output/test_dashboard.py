"""The page's server: its answers and its refusals."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import time
from urllib.parse import urljoin

import cv2
import httpx
import numpy as np
import pytest
import yaml

from tests.output.test_pages import FAULTS, keep
from thermocald.daemon.live_state import LiveState, status_warnings
from thermocald.epoch import Epoch
from thermocald.errors import ConfigurationError
from thermocald.output.dashboard import serve
from thermocald.output.dashboard.application import build_application
from thermocald.output.dashboard.server import bind
from thermocald.photogrammetry.camera.camera_model import Sensor, project
from thermocald.photogrammetry.camera.conversions import opencv_terms
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.series import EpochResult, Event

TOKEN = "a-token-of-enough-characters"
LOOPBACK, STATION = "http://127.0.0.1", "http://station.example"
_CSV_REQUEST = b"GET /api/series.csv?camera=rpi&series=M1 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
DEVICE = {"device": "open", "why": "", "since": None, "faults": 0}
LAST = {"epoch": 1200, "temperature": 21.5, "c": 3.04, "sd_c": 1e-4, "status": "ok"}


def add_series(path, camera, times, values=None, size=(64, 48)):
    """Add a series M1 to a store, 20 °C and 0.01 K more in each epoch; values: of all parameters,
    None: not calibrated.
    """
    sensor = Sensor(*size, 0.003)
    head = Head(camera, "M1", 10.0, CameraSpec(camera, sensor), {"temperature": Channel()})
    with Store.open(path, "append", durable=False) as store:
        series = store.create_series(head, TestField.build(["a"], np.zeros((1, 3))))
        for k, time in enumerate(times, start=1):
            result = None
            if values is not None:
                parameters = np.full(16, float(values[k - 1]))
                result = EpochResult("ok", "", parameters, np.eye(16), 1.0, 10, 2, ())
            store.append(series, Epoch(k, time, time, {"temperature": 20.0 + k / 100}), result)


def status_of(store, cameras, **changes):
    """Return what a daemon without a fault writes to status.json; cameras: {name: its part}."""
    parts = {
        name: {**DEVICE, "series": "M1", "period_s": 10.0, **part} for name, part in cameras.items()
    }
    return {
        "version": "0", "pid": 1, "utc": 1.6e9, "started": 1.6e9, "stalled": [],
        "clock": {"trusted": True}, "frames": {"paused": ""},
        "store": {"state": "ok", "waiting": 0, "lost": 0, "path": str(store)},
        "cameras": parts, "thermometers": {"housing": DEVICE}, "outputs": {}, **changes,
    }  # fmt: skip


@pytest.fixture(scope="module")
def store_path(tmp_path_factory):
    """A store of 1200 epochs."""
    path, numbers = tmp_path_factory.mktemp("store") / "t.db", np.arange(1, 1201)
    add_series(path, "rpi", (1.6e9 + 10 * numbers).tolist(), numbers)
    with Store.open(path, "append") as store:
        store.add_event(Event(1.6e9, "knock", "<b>somebody</b> came"))
    return path


@pytest.fixture
def live(tmp_path, store_path):
    """The live folder of a running daemon."""
    folder = tmp_path / "live"
    folder.mkdir()
    status = status_of(store_path, {"rpi": {"last": LAST, "stored": 1200}})
    (folder / "status.json").write_text(json.dumps(status))
    (folder / "rpi.json").write_text(json.dumps({"row": LAST}))
    (folder / "rpi.jpg").write_bytes(b"\xff\xd8 picture \xff\xd9")
    (tmp_path / "secret.json").write_text('{"secret": 1}')
    return folder


def client(store, live, token=None, host="127.0.0.1", base=LOOPBACK):
    """Return a call that asks the application in this process, and keeps cookies as a browser."""
    transport = httpx.ASGITransport(build_application(store, lambda: live, token, host))
    browser = httpx.AsyncClient(transport=transport, base_url=base)
    return lambda path, method="GET", **options: asyncio.run(
        browser.request(method, path, **options)
    )


@pytest.fixture
def get(store_path, live):
    return client(store_path, live)


@pytest.fixture
def guarded(store_path, live):
    """token → a client of a page that wants it."""
    return lambda token=TOKEN: client(store_path, live, token, "0.0.0.0", STATION)


@pytest.mark.parametrize(("late", "shown"), [(0, 5), (3, 3)])
def test_epochs_before_the_clock_was_set_are_counted_and_not_drawn(tmp_path, late, shown):
    """A Raspberry Pi without a battery begins in 1970; a simulated series stays there."""
    times = [10.0 * n + (1.75e9 if n >= 5 - late else 0.0) for n in range(5)]
    add_series(tmp_path / "t.db", "rpi", times)
    columns = client(tmp_path / "t.db", tmp_path)("/api/columns?camera=rpi&series=M1").json()
    assert (columns["epochs"], columns["unset"]) == (shown, 5 - shown)
    assert min(columns["frame_time"]) == (1.75e9 + 20.0 if late else 0.0)


def test_charts_csv_status_frame_and_events(get):
    """Charts are means over bins, limited to the last hour; the CSV has every epoch."""
    series = {"camera": "rpi", "series": "M1"}
    every = get("/api/columns", params={**series, "points": 100}).json()
    assert (every["epochs"], every["per_point"]) == (1200, 12)
    assert every["c"][0] == pytest.approx(np.arange(1, 13).mean())
    assert every["c"][-1] == pytest.approx(np.arange(1189, 1201).mean())
    hour = get("/api/columns", params={**series, "last": 3600, "points": 2000}).json()
    assert (hour["epochs"], hour["frame_time"][-1]) == (361, 1.6e9 + 12000)

    answer = get("/api/series.csv", params=series)
    lines = answer.text.splitlines()
    assert len(lines) == 1201
    first = dict(zip(lines[0].split(","), lines[1].split(","), strict=True))
    assert (first["epoch"], first["c"], first["status"]) == ("1", "1.0", "ok")
    assert first["n_observations"].isdigit()
    assert float(first["temperature"]) == 20.01
    assert 'filename="rpi-M1.csv"' in answer.headers["content-disposition"]

    assert get("/api/status").json()["cameras"]["rpi"]["last"]["epoch"] == 1200
    assert get("/api/cameras/rpi/epoch").json()["row"]["c"] == 3.04
    assert get("/api/cameras/rpi/frame").content.startswith(b"\xff\xd8")
    assert get("/api/events").json()[0]["text"] == "<b>somebody</b> came"
    page = get("/")
    assert "https://" not in page.text
    assert "http://" not in page.text.replace("http://www.w3.org", "")
    assert "script-src 'self'" in page.headers["content-security-policy"]
    assert len(get("/static/plotly.js").content) > 1_000_000


def test_health_and_metrics(get, live):
    assert get("/healthz").json() == {"ok": True, "why": ""}
    text = get("/metrics").text
    assert 'thermocald_temperature{camera="rpi",series="M1"} 21.5' in text
    assert 'thermocald_device_up{kind="thermometer",name="housing"} 1.0' in text
    (live / "status.json").unlink()
    assert get("/healthz").status_code == 503
    assert "thermocald_up 0.0" in get("/metrics").text
    assert get("/camera.json").json()["error"] == "no daemon with a camera is running"


def test_the_camera_of_now_in_opencv_terms_and_for_ros(get, live):
    """Both describe one camera, with which OpenCV projects as the program does.

    A variance of which rounding left nothing was a complex number, and stopped the daemon.
    """
    assert get("/camera.json").status_code == 404
    values = np.array([3.04, 0.012, -0.021, -6e-3, 4e-4, 0, 2e-5, -3e-5, 0, 0])
    sensor = Sensor(3280, 2464, 0.00112)
    variances = np.array([1e-8, -1e-18, 9e-8, 0, 0, 0, 0, 0, 0, 0])
    names = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2")
    row = {
        **LAST, **dict(zip(names, values.tolist(), strict=True)), "status": "resected",
        "frame_time": 1.6e9, "pixel_pitch": 0.00112, "X0": 1.0, "sd_X0": 0.1,
        "opencv": opencv_terms(sensor, values, np.diag(variances)),
    }  # fmt: skip
    LiveState(live).write_epoch("rpi", row, None, None)
    now = get("/camera.json", params={"camera": "rpi"}).json()
    assert (now["width"], now["height"], now["status"]) == (3280, 2464, "resected")
    assert (now["sd_fx"], now["sd_cx"]) == (pytest.approx(1e-4 / 0.00112), None)
    assert now["pose"]["X0"] == 1.0
    K = np.array([[now["fx"], 0, now["cx"]], [0, now["fy"], now["cy"]], [0, 0, 1]])
    terms = np.array([now[k] for k in ("k1", "k2", "p1", "p2", "k3")])
    points = np.array([[0.3, 0.2, -1.0], [-0.4, 0.1, -1.0]])
    seen, _ = cv2.projectPoints(points * [1, -1, -1], np.zeros(3), np.zeros(3), K, terms)
    assert seen[:, 0] == pytest.approx(project(sensor, values, np.zeros(6), points), abs=1e-9)
    text = get("/camera.yaml").text
    ros = yaml.safe_load(text)
    assert ros["camera_matrix"]["data"] == pytest.approx(K.ravel().tolist())
    assert ros["distortion_coefficients"]["data"] == pytest.approx(terms.tolist())
    assert "degC" in text


SERIES = "/api/columns?camera=rpi&series=M1"


@pytest.mark.parametrize(
    "path",
    [
        "/static/../application.py", "/static/..%2fapplication.py", "/static//etc/passwd",
        "/api/cameras/%2e%2e%2fsecret/epoch", "/api/cameras/status/epoch", "/../../etc/passwd",
        "/api/columns?camera=rpi", f"{SERIES}'--", f"{SERIES}&last=nan", f"{SERIES}&points=1e99",
        f"/api/columns?camera={'r' * 5000}&series=M1", "/api/columns?camera=rpi%00&series=M1",
        f"{SERIES}&last=1;drop table epoch",
    ],
)  # fmt: skip
def test_no_path_leads_out_and_hostile_values_are_refused_in_a_sentence(get, path):
    answer = get(path)
    assert answer.status_code in (404, 400)
    assert "secret" not in answer.text.replace("../secret", "")
    assert "root:" not in answer.text
    assert "?" not in path or answer.json()["error"]


def test_nothing_can_be_written(get):
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        assert get("/api/series.csv", method).status_code == 405


@pytest.mark.parametrize("token", [TOKEN, "tökän", "😀 four", 'quo"te;,=\\'])
def test_with_a_token_nothing_is_shown_without_it(guarded, token):
    get = guarded(token)
    bearer = [(b"authorization", b"Bearer " + token.encode())]
    for path in ("/", "/api/status", "/metrics", "/api/cameras/rpi/frame", "/static/page.js"):
        assert get(path).status_code == 401
        assert get(path, headers=[(b"authorization", b"Bearer wrong")]).status_code == 401
        assert get(path, headers=bearer).status_code == 200
    assert get("/healthz").status_code == 200
    foreign = [*bearer, (b"origin", b"http://evil.com")]
    assert get("/", headers=foreign).status_code == 403
    assert get("/", headers=[*bearer, (b"origin", STATION.encode())]).status_code == 200
    assert get("/", params={"token": token + "x"}).status_code == 401
    moved = get("/", params={"token": token})
    assert moved.status_code == 303
    assert token not in moved.headers["location"] + moved.headers["set-cookie"]
    assert get("/").status_code == 200  # the cookie


@pytest.mark.parametrize(
    ("value", "status"),
    [("Bearer {}", 200), ("bEaReR  {} ", 200), ("{}", 401), ("Basic {}", 401), ("Bearer{}", 401),
     ("Bearer", 401), ("Bearer {} x", 401), ("XBearer {}", 401), ("Bearer {0},{0}", 401)],
)  # fmt: skip
def test_authorization_needs_its_scheme(guarded, value, status):
    found = guarded()("/", headers={"authorization": value.format(TOKEN)})
    assert found.status_code == status


@pytest.mark.parametrize(
    "path",
    ["//evil.com/", "///evil.com", "/\\evil.com", "/%09/evil.com", "/%5cevil.com",
     "/%2f%2fevil.com", "/%0d%0aLocation:%20//evil.com", "/.//evil", "/@evil.com"],
)  # fmt: skip
def test_the_token_leads_nowhere_else(guarded, path):
    moved = guarded()(f"{STATION}{path}?token={TOKEN}")
    assert moved.status_code in (303, 404)
    location = moved.headers.get("location", "/")
    assert location.startswith("/")
    assert location[1:2] not in ("/", "\\")
    assert location.isprintable()
    assert urljoin(STATION, location).startswith(f"{STATION}/")


@pytest.mark.parametrize(
    ("base", "headers", "status"),
    [
        ("http://evil.example", {}, 400),
        ("http://127.0.0.1.evil.com", {}, 400),
        ("http://[::1]:8437", {}, 200),
        ("http://LOCALHOST.:1", {}, 200),
        (LOOPBACK, {"origin": "http://evil.com"}, 403),
        (LOOPBACK, {"origin": "null"}, 403),
        (LOOPBACK, {"origin": "http://localhost:8437"}, 200),
        (LOOPBACK, {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, 403),
        (LOOPBACK, {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, 200),
    ],
)
def test_dns_rebinding_and_foreign_pages_are_refused(store_path, live, base, headers, status):
    get = client(store_path, live, base=base)
    assert get("/api/status", headers=headers).status_code == status


def start_page(store, live) -> tuple[subprocess.Popen, int]:
    """Return the process of `dashboard` on a store, and its port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "thermocald", "dashboard", "--store", str(store)]
    command += ["--live", str(live), "--port", str(port)]
    environment = os.environ | {"MALLOC_ARENA_MAX": "2"}  # as in its systemd unit
    server = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    assert "the page is at" in server.stderr.readline()
    return server, port


def test_it_takes_connections_before_it_is_announced():
    """`serve` announces the page, and starts the server afterwards."""
    with bind("127.0.0.1", 0) as listening:
        socket.create_connection(listening.getsockname(), timeout=5).close()


def test_a_page_that_is_open_hears_the_end(store_path, live):
    """SIGTERM with an open stream: the page learns when acquisition stopped; nothing is logged."""
    with Store.open(store_path, "append") as opened:
        opened.add_event(Event(1.7e9, "stopped", "thermocald stopped"))
    server, port = start_page(store_path, live)
    with server:
        with (
            httpx.stream("GET", f"http://127.0.0.1:{port}/api/stream", timeout=20) as page,
            socket.create_connection(("127.0.0.1", port)) as stuck,
        ):
            stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            stuck.sendall(_CSV_REQUEST)  # and reads nothing of the answer
            told = (line for line in page.iter_lines() if line.startswith("data: "))
            assert json.loads(next(told)[6:])["pid"] == 1
            (live / "status.json").unlink()
            server.send_signal(signal.SIGTERM)
            assert json.loads(next(told)[6:]) == {"stopped": 1.7e9}
            assert next(told, None) is None
        assert server.stderr.read() == ""


def test_the_table_of_a_series_without_epochs_has_its_header(tmp_path):
    """Its camera's name, which no header of an answer may hold, was an error of the server."""
    add_series(tmp_path / "t.db", "相机", [])
    get = client(tmp_path / "t.db", tmp_path, None, "::1", "http://[::1]")
    answer = get("/api/series.csv", params={"camera": "相机", "series": "M1"})
    assert answer.headers["content-disposition"] == 'attachment; filename="---M1.csv"'
    (header,) = answer.text.splitlines()
    assert header.startswith("epoch,frame_time,temperature_time,temperature,c,x0,")


def test_open_to_others_it_wants_a_token(tmp_path):
    short = tmp_path / "token"
    short.write_text("short")
    for mode, token, reason in (
        (0o640, None, "token-file"), (0o644, short, "everybody may read"), (0o640, short, "16"),
    ):  # fmt: skip
        short.chmod(mode)
        with pytest.raises(ConfigurationError, match=reason):
            serve(tmp_path / "t.db", lambda: tmp_path, "0.0.0.0", 8437, token)


# --- the page in a real browser, with several cameras: all of it shows the chosen one ---------

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
            late = time.time() + 600.0  # not yet silent, however busy the machine
            os.utime(live / "status.json", (late, late))

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
    curves, card = (page.evaluate(_RIGHT, s)[0] for s in ("#course .main-svg", "section.wide"))
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
