"""The page's server: its answers and its refusals."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import sys
from urllib.parse import urljoin

import cv2
import httpx
import numpy as np
import pytest
import yaml

from thermocald.daemon.live_state import LiveState
from thermocald.epoch import Epoch
from thermocald.errors import ConfigurationError
from thermocald.output.dashboard import serve
from thermocald.output.dashboard.application import build_application
from thermocald.output.dashboard.view import View
from thermocald.photogrammetry.camera.camera_model import Sensor, project
from thermocald.photogrammetry.camera.conversions import opencv_terms
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.series import EpochResult, Event

TOKEN = "a-token-of-enough-characters"
_CSV_REQUEST = b"GET /api/series.csv?camera=rpi&series=M1 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
DEVICE = {"device": "open", "why": "", "faults": 0}


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


@pytest.fixture(scope="module")
def store_path(tmp_path_factory):
    """A store of 1200 epochs."""
    path, numbers = tmp_path_factory.mktemp("store") / "t.db", np.arange(1, 1201)
    add_series(path, "rpi", (1.6e9 + 10 * numbers).tolist(), numbers)
    with Store.open(path, "append") as store:
        store.add_event(Event(1.6e9, "knock", "<b>somebody</b> came"))
    return path


@pytest.fixture
def folders(tmp_path, store_path):
    """The store and the live folder of a running daemon."""
    path = store_path
    live = tmp_path / "live"
    live.mkdir()
    last = {"epoch": 1200, "temperature": 21.5, "c": 3.04, "sd_c": 1e-4, "status": "ok"}
    camera = {**DEVICE, "series": "M1", "period_s": 10.0, "last": last, "stored": 1200}
    status = {
        "version": "0", "pid": 1, "utc": 0.0, "started": 0.0, "stalled": [],
        "clock": {"trusted": True},
        "store": {"state": "ok", "waiting": 0, "lost": 0, "path": str(path)},
        "frames": {"paused": ""}, "cameras": {"rpi": camera}, "thermometers": {"housing": DEVICE},
        "outputs": {},
    }  # fmt: skip
    (live / "status.json").write_text(json.dumps(status))
    (live / "rpi.json").write_text(json.dumps({"row": last}))
    (live / "rpi.jpg").write_bytes(b"\xff\xd8 picture \xff\xd9")
    (tmp_path / "secret.json").write_text('{"secret": 1}')
    return path, live


class Client:
    """Requests to an application in this process, with a browser's memory for cookies."""

    def __init__(self, application, base: str) -> None:
        self._application = application
        self._base = base
        self._cookies = httpx.Cookies()

    def request(self, method: str, path: str, **options) -> httpx.Response:
        async def ask() -> httpx.Response:
            transport = httpx.ASGITransport(self._application, raise_app_exceptions=True)
            async with httpx.AsyncClient(
                transport=transport, base_url=self._base, cookies=self._cookies
            ) as client:
                answer = await client.request(method, path, **options)
                self._cookies = client.cookies
                return answer

        return asyncio.run(ask())

    def get(self, path: str, **options) -> httpx.Response:
        return self.request("GET", path, **options)


@pytest.fixture
def client_of(folders):
    """token, host → a client of the application."""

    def make(token=None, host="127.0.0.1", base="http://127.0.0.1"):
        return Client(build_application(*folders, token, host), base)

    return make


@pytest.mark.parametrize(("late", "shown"), [(0, 5), (3, 3)])
def test_epochs_before_the_clock_was_set_are_counted_and_not_drawn(tmp_path, late, shown):
    """A Raspberry Pi without a battery begins in 1970; a simulated series stays there."""
    times = [10.0 * n + (1.75e9 if n >= 5 - late else 0.0) for n in range(5)]
    add_series(tmp_path / "t.db", "rpi", times)
    columns = View(tmp_path / "t.db", tmp_path).columns("rpi", "M1", None, 100)
    assert (columns["epochs"], columns["unset"]) == (shown, 5 - shown)
    assert min(columns["frame_time"]) == (1.75e9 + 20.0 if late else 0.0)


def test_charts_csv_status_frame_and_events(client_of):
    """Charts are means over bins, limited to the last hour; the CSV has every epoch."""
    client = client_of()
    query = {"camera": "rpi", "series": "M1", "points": 100}
    every = client.get("/api/columns", params=query).json()
    assert (every["epochs"], every["per_point"]) == (1200, 12)
    assert every["c"][0] == pytest.approx(np.arange(1, 13).mean())
    assert every["c"][-1] == pytest.approx(np.arange(1189, 1201).mean())
    hour = client.get("/api/columns", params={**query, "last": 3600, "points": 2000}).json()
    assert hour["epochs"] == 361
    assert hour["frame_time"][-1] == 1.6e9 + 12000

    answer = client.get("/api/series.csv", params={"camera": "rpi", "series": "M1"})
    lines = answer.text.splitlines()
    assert len(lines) == 1201
    first = dict(zip(lines[0].split(","), lines[1].split(","), strict=True))
    assert (first["epoch"], first["c"], first["status"]) == ("1", "1.0", "ok")
    assert first["n_observations"].isdigit()
    assert float(first["temperature"]) == 20.01
    assert 'filename="rpi-M1.csv"' in answer.headers["content-disposition"]

    assert client.get("/api/status").json()["cameras"]["rpi"]["last"]["epoch"] == 1200
    assert client.get("/api/cameras/rpi/epoch").json()["row"]["c"] == 3.04
    assert client.get("/api/cameras/rpi/frame").content.startswith(b"\xff\xd8")
    assert client.get("/api/events").json()[0]["text"] == "<b>somebody</b> came"
    page = client.get("/").text
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert "https://" not in page
    policy = client.get("/").headers["content-security-policy"]
    assert "script-src 'self'" in policy
    assert len(client.get("/static/plotly.js").content) > 1_000_000


def test_health_and_metrics(client_of, folders):
    client = client_of()
    assert client.get("/healthz").json() == {"ok": True, "why": ""}
    text = client.get("/metrics").text
    assert 'thermocald_temperature{camera="rpi",series="M1"} 21.5' in text
    assert 'thermocald_device_up{kind="thermometer",name="housing"} 1.0' in text
    (folders[1] / "status.json").unlink()
    assert client.get("/healthz").status_code == 503
    assert "thermocald_up 0.0" in client.get("/metrics").text


def test_the_camera_of_now_in_opencv_terms_and_for_ros(client_of, folders):
    """Both describe one camera, with which OpenCV projects as the program does."""
    client = client_of()
    assert client.get("/camera.json").status_code == 404
    values = np.array([3.04, 0.012, -0.021, -6e-3, 4e-4, 0, 2e-5, -3e-5, 0, 0])
    sensor = Sensor(3280, 2464, 0.00112)
    sds = np.array([1e-4, 2e-4, 3e-4, 0, 0, 0, 0, 0, 0, 0])
    names = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2")
    row = {
        **dict(zip(names, values.tolist(), strict=True)), "status": "resected", "epoch": 7,
        "temperature": 21.5, "frame_time": 1.6e9, "pixel_pitch": 0.00112, "X0": 1.0, "sd_X0": 0.1,
        "opencv": opencv_terms(sensor, values, np.diag(sds**2)),
    }  # fmt: skip
    (folders[1] / "rpi.json").write_text(json.dumps({"row": row}))
    now = client.get("/camera.json", params={"camera": "rpi"}).json()
    assert (now["width"], now["height"], now["status"]) == (3280, 2464, "resected")
    assert now["sd_fx"] == pytest.approx(1e-4 / 0.00112)
    assert now["pose"]["X0"] == 1.0
    K = np.array([[now["fx"], 0, now["cx"]], [0, now["fy"], now["cy"]], [0, 0, 1]])
    terms = np.array([now[k] for k in ("k1", "k2", "p1", "p2", "k3")])
    points = np.array([[0.3, 0.2, -1.0], [-0.4, 0.1, -1.0]])
    seen, _ = cv2.projectPoints(points * [1, -1, -1], np.zeros(3), np.zeros(3), K, terms)
    assert seen[:, 0] == pytest.approx(project(sensor, values, np.zeros(6), points), abs=1e-9)
    ros = yaml.safe_load(client.get("/camera.yaml").text)
    assert ros["camera_matrix"]["data"] == pytest.approx(K.ravel().tolist())
    assert ros["distortion_coefficients"]["data"] == pytest.approx(terms.tolist())
    assert "degC" in client.get("/camera.yaml").text


def test_a_weak_epoch_of_whose_variance_rounding_left_nothing(folders):
    """A complex number stopped the daemon: its status could not be written."""
    values = np.array([3.04, 0.012, -0.021, -6e-3, 0, 0, 0, 0, 0, 0])
    variances = np.array([1e-8, -1e-18, 1e-8, 0, 0, 0, 0, 0, 0, 0])
    terms = opencv_terms(Sensor(3280, 2464, 0.00112), values, np.diag(variances))
    assert terms["sd_fx"] > 0
    assert np.isnan(terms["sd_cx"])
    LiveState(folders[1]).write_epoch("weak", {"opencv": terms}, None, None)
    assert json.loads((folders[1] / "weak.json").read_text())["row"]["opencv"]["sd_cx"] is None


@pytest.mark.parametrize(
    "path",
    [
        "/static/../application.py", "/static/..%2fapplication.py", "/static//etc/passwd",
        "/api/cameras/%2e%2e%2fsecret/epoch", "/api/cameras/status/epoch", "/../../etc/passwd",
    ],
)  # fmt: skip
def test_no_path_leads_out(client_of, path):
    answer = client_of().get(path)
    assert answer.status_code in (404, 400)
    assert "secret" not in answer.text.replace("../secret", "")
    assert "root:" not in answer.text


@pytest.mark.parametrize(
    "query",
    [
        "camera=rpi", "camera=rpi&series=M1'--", "camera=rpi&series=M1&last=nan",
        "camera=rpi&series=M1&points=1e99", "camera=" + "r" * 5000 + "&series=M1",
        "camera=rpi%00&series=M1", "camera=rpi&series=M1&last=1;drop table epoch",
    ],
)  # fmt: skip
def test_hostile_values_are_refused_in_a_sentence(client_of, query):
    answer = client_of().get("/api/columns?" + query)
    assert answer.status_code in (400, 404)
    assert answer.json()["error"]


def test_nothing_can_be_written(client_of):
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        assert client_of().request(method, "/api/series.csv").status_code == 405


def test_with_a_token_nothing_is_shown_without_it(client_of):
    client = client_of(TOKEN, "0.0.0.0", "http://station.example")
    for path in ("/", "/api/status", "/metrics", "/api/cameras/rpi/frame", "/static/page.js"):
        assert client.get(path).status_code == 401
        assert client.get(path, headers={"authorization": "Bearer wrong"}).status_code == 401
        assert client.get(path, headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200
    assert client.get("/healthz").status_code == 200
    moved = client.get(f"/?token={TOKEN}")
    assert moved.status_code == 303
    assert TOKEN not in moved.headers["location"]
    assert client.get("/").status_code == 200  # the cookie
    foreign = {"authorization": f"Bearer {TOKEN}", "origin": "http://evil.com"}
    assert client.get("/", headers=foreign).status_code == 403
    own = {**foreign, "origin": "http://station.example"}
    assert client.get("/", headers=own).status_code == 200


@pytest.mark.parametrize("token", ["tökän", "😀 four", 'quo"te;,=\\'])
def test_a_token_may_hold_any_mark(client_of, token):
    client = client_of(token, "0.0.0.0", "http://station.example")
    assert client.get("/", params={"token": token + "x"}).status_code == 401
    bearer = [(b"authorization", b"Bearer " + token.encode())]
    assert client.get("/api/status", headers=bearer).status_code == 200
    moved = client.get("/", params={"token": token}, follow_redirects=False)
    assert moved.status_code == 303
    assert token not in moved.headers["set-cookie"]
    assert client.get("/").status_code == 200  # the cookie


@pytest.mark.parametrize(
    ("value", "status"),
    [("Bearer {}", 200), ("bEaReR  {} ", 200), ("{}", 401), ("Basic {}", 401), ("Bearer{}", 401),
     ("Bearer", 401), ("Bearer {} x", 401), ("XBearer {}", 401), ("Bearer {0},{0}", 401)],
)  # fmt: skip
def test_authorization_needs_its_scheme(client_of, value, status):
    client = client_of(TOKEN, "0.0.0.0", "http://station.example")
    found = client.get("/", headers={"authorization": value.format(TOKEN)})
    assert found.status_code == status


@pytest.mark.parametrize(
    "path",
    ["//evil.com/", "///evil.com", "/\\evil.com", "/%09/evil.com", "/%5cevil.com",
     "/%2f%2fevil.com", "/%0d%0aLocation:%20//evil.com", "/.//evil", "/@evil.com"],
)  # fmt: skip
def test_the_token_leads_nowhere_else(client_of, path):
    client = client_of(TOKEN, "0.0.0.0", "http://station.example")
    url = f"http://station.example{path}?token={TOKEN}"
    moved = client.get(url, follow_redirects=False)
    assert moved.status_code in (303, 404)
    location = moved.headers.get("location", "/")
    assert location.startswith("/")
    assert location[1:2] not in ("/", "\\")
    assert location.isprintable()
    assert urljoin("http://station.example/", location).startswith("http://station.example/")


@pytest.mark.parametrize(
    ("base", "headers", "status"),
    [
        ("http://evil.example", {}, 400),
        ("http://127.0.0.1.evil.com", {}, 400),
        ("http://[::1]:8437", {}, 200),
        ("http://LOCALHOST.:1", {}, 200),
        ("http://127.0.0.1", {"origin": "http://evil.com"}, 403),
        ("http://127.0.0.1", {"origin": "null"}, 403),
        ("http://127.0.0.1", {"origin": "http://localhost:8437"}, 200),
        ("http://127.0.0.1", {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, 403),
        ("http://127.0.0.1", {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, 200),
    ],
)
def test_dns_rebinding_and_foreign_pages_are_refused(client_of, base, headers, status):
    assert client_of(base=base).get("/api/status", headers=headers).status_code == status


def start_page(store, live) -> tuple[subprocess.Popen, int]:
    """Return the process of `dashboard` on a store, and its port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "thermocald", "dashboard", "--store", str(store)]
    command += ["--live", str(live), "--port", str(port)]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert "the page is at" in server.stderr.readline()
    return server, port


def test_a_page_that_is_open_hears_the_end(folders, tmp_path):
    """SIGTERM with an open stream: the page learns when acquisition stopped; nothing is logged."""
    store, live = folders
    with Store.open(store, "append") as opened:
        opened.add_event(Event(1.7e9, "stopped", "thermocald stopped"))
    server, port = start_page(store, live)
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
    client = Client(build_application(tmp_path / "t.db", tmp_path, None, "::1"), "http://[::1]")
    answer = client.get("/api/series.csv", params={"camera": "相机", "series": "M1"})
    assert answer.headers["content-disposition"] == 'attachment; filename="---M1.csv"'
    header, *rows = answer.text.splitlines()
    assert header.startswith("epoch,frame_time,temperature_time,temperature,c,x0,")
    assert rows == []


def test_open_to_others_it_wants_a_token(tmp_path):
    with pytest.raises(ConfigurationError, match="token-file"):
        serve(tmp_path / "t.db", tmp_path, "0.0.0.0", 8437)
    short = tmp_path / "token"
    short.write_text("short")
    with pytest.raises(ConfigurationError, match="everybody may read"):
        serve(tmp_path / "t.db", tmp_path, "0.0.0.0", 8437, short)
    short.chmod(0o640)
    with pytest.raises(ConfigurationError, match="16"):
        serve(tmp_path / "t.db", tmp_path, "0.0.0.0", 8437, short)
