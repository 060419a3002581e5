"""The routes of the page: HTML, JSON, a stream of events, and metrics; all of them only read.

`/metrics` is the daemon's status in the format of Prometheus.
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import hmac
import io
import json
import math
import re
import shutil
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from prometheus_client import generate_latest
from prometheus_client.core import GaugeMetricFamily
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from thermocald.addresses import HostNames
from thermocald.errors import DataError, ThermocaldError, UsageError
from thermocald.names import LONGEST_NAME
from thermocald.output.dashboard.server import Limits
from thermocald.output.dashboard.view import View

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence

    from starlette.types import ASGIApp, Receive, Scope, Send


_CAMERA = {
    "ticks": "Ticks of the camera's schedule.",
    "skipped": "Ticks skipped because they were too late.",
    "late_p99_s": "Lateness of ticks, 99th percentile of the last 1000, s.",
    "lost": "Ticks in which the camera gave no frame.",
    "waiting": "Epochs not yet in the store.",
    "deferred": "Epochs whose calibration was deferred.",
    "caught_up": "Deferred epochs calibrated since.",
    "stored": "Epochs stored by this process.",
}
_EPOCH = {
    "epoch": "Number of the last epoch.",
    "temperature": "Reference temperature, degrees Celsius.",
    "c": "Principal distance, mm.",
    "sd_c": "Standard deviation of c, mm.",
    "x0": "Principal point x, mm.",
    "sd_x0": "Standard deviation of x0, mm.",
    "y0": "Principal point y, mm.",
    "sd_y0": "Standard deviation of y0, mm.",
    "sigma0": "Standard deviation of unit weight.",
    "n_observations": "Targets measured.",
    "n_rejected": "Targets rejected.",
}
_ONLINE = {
    "drift_px_per_min": "Drift of c, x0, y0, px per minute.",
    "ready_in_s": "Time until the camera is steady, s.",
}


def _families(status: Mapping[str, Any]) -> Iterator[GaugeMetricFamily]:
    """Yield a daemon's status as metrics; only that none answers if no daemon runs."""
    single: list[tuple[str, str, float]] = [("up", "Whether a daemon answers.", bool(status))]
    if status:
        store = status["store"]
        single += [
            ("status_age_s", "Age of the daemon's status, s.", status["age_s"]),
            ("stalled", "Devices or pipelines that hang.", len(status["stalled"])),
            ("store_ok", "Whether the store can be written.", store["state"] == "ok"),
            ("store_waiting", "Epochs waiting in memory.", store["waiting"]),
            ("store_lost", "Epochs taken but not stored.", store["lost"]),
            ("clock_trusted", "Whether UTC is synchronised.", status["clock"]["trusted"]),
        ]
    for name, about, value in single:
        yield GaugeMetricFamily(f"thermocald_{name}", about, value=float(value))
    if not status:
        return
    labels = ["kind", "name"]
    up = GaugeMetricFamily("thermocald_device_up", "Whether a device is open.", labels=labels)
    for kind in ("cameras", "thermometers", "outputs"):
        for name, device in status[kind].items():
            up.add_metric([kind[:-1], name], float(device["device"] == "open"))
    yield up
    for names, inner in ((_CAMERA, ()), (_EPOCH, ("last",)), (_ONLINE, ("last", "online"))):
        for key, about in names.items():
            family = GaugeMetricFamily(f"thermocald_{key}", about, labels=["camera", "series"])
            for name, camera in status["cameras"].items():
                values = camera
                for part in inner:
                    values = values.get(part) or {}
                if (value := values.get(key)) is not None:
                    family.add_metric([name, camera["series"]], float(value))
            yield family


_STATIC = Path(__file__).parent / "static"
_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; connect-src 'self'; "
    "img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}
_PLOTLY = "package_data/plotly.min.js"
_COOKIE = "thermocald_token"
_STREAM_EVERY_S = 0.5
_ALIVE_EVERY = 22


def build_application(
    store: Path, live: Callable[[], Path], token: str | None, host: str, names: Sequence[str] = ()
) -> Starlette:
    """Return the application.

    token: None to let every client read; names: further host names of the page.
    """
    application = Starlette(
        routes=[
            Route("/", lambda _: FileResponse(_STATIC / "index.html")),
            Route("/static/plotly.js", _plotly),
            Mount("/static", StaticFiles(directory=_STATIC)),
            Route("/api/stream", _stream),
            *(Route(path, partial(_answer, read)) for path, read in _ANSWERS.items()),
        ],
        middleware=[
            Middleware(_Guard, token=token, names=HostNames(host, names)),
            Middleware(Limits),
        ],
        exception_handlers={
            ThermocaldError: lambda _, error: JSONResponse(
                {"error": str(error)}, 400 if isinstance(error, UsageError) else 404
            )
        },
    )
    application.state.view = View(store, live)
    application.state.ends = lambda: False  # whether the server is about to end
    return application


@dataclass(eq=False)
class _Guard:
    """A guard that refuses unknown host names (DNS rebinding) or, if set, requests without token.

    The token is sent as `Authorization: Bearer …`, or once as `?token=…`, which sets a cookie.
    """

    app: ASGIApp
    token: str | None
    names: HostNames

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        request = Request(scope)
        response: Response | None = None
        if scope["method"] not in ("GET", "HEAD"):
            response = JSONResponse({"error": "this page only reads"}, 405)
        elif self._is_foreign(request):
            response = JSONResponse({"error": "requests from other sites are refused"}, 403)
        elif self.token is None:
            if not self.names.allow_host(",".join(request.headers.getlist("host"))):
                response = JSONResponse({"error": "unknown host name"}, 400)
        elif request.url.path != "/healthz":
            response = self._check(request)

        async def send_with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                given = {name.lower() for name, _ in message["headers"]}
                message["headers"] += [
                    (k.encode(), v.encode()) for k, v in _HEADERS.items() if k.encode() not in given
                ]
            await send(message)

        await (response or self.app)(scope, receive, send_with_headers)

    def _is_foreign(self, request: Request) -> bool:
        """Return whether the browser reports that the request comes from another site."""
        origin = request.headers.get("origin")
        if origin is not None:
            own = request.headers.get("host", "")
            return not (
                self.names.allow_origin(origin)
                if self.token is None
                else own and origin.partition("://")[2].lower() == own.lower()
            )
        site, mode = (request.headers.get(f"sec-fetch-{key}", "") for key in ("site", "mode"))
        return site == "cross-site" and mode != "navigate"

    def _check(self, request: Request) -> Response | None:
        assert self.token is not None
        asked = request.query_params.get("token")
        if asked is not None and _same(asked, self.token):
            moved = RedirectResponse("/" + request.url.path.lstrip("/"), 303)  # //host is another
            moved.set_cookie(_COOKIE, _digest(self.token), httponly=True, samesite="strict")
            return moved
        scheme, _, bearer = request.headers.get("authorization", "").partition(" ")
        bearer = bearer.strip().encode("latin-1").decode(errors="replace")
        if scheme.lower() == "bearer" and _same(bearer, self.token):
            return None
        if _same(request.cookies.get(_COOKIE, ""), _digest(self.token)):
            return None
        return JSONResponse({"error": "a token is needed"}, 401, {"www-authenticate": "Bearer"})


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(errors="replace"), b.encode(errors="replace"))


def _digest(token: str) -> str:
    """Return a token's hash for the cookie: a header cannot hold every token, nor should it."""
    return hashlib.sha256(token.encode(errors="replace")).hexdigest()


@cache
def _plotly_script() -> bytes:
    # read from its package without importing it, which would take 30 MB of memory
    found = find_spec("plotly")
    if found is None or found.origin is None:
        raise DataError("the page's charts need plotly: pip install 'thermocald[dashboard]'")
    packed = io.BytesIO()
    with (
        (Path(found.origin).parent / _PLOTLY).open("rb") as script,
        gzip.GzipFile(fileobj=packed, mode="wb", compresslevel=6) as file,
    ):
        shutil.copyfileobj(script, file)
    return packed.getvalue()


def _plotly(_: Request) -> Response:
    headers = {"content-encoding": "gzip", "cache-control": "max-age=86400"}
    return Response(_plotly_script(), media_type="text/javascript", headers=headers)


async def _stream(request: Request) -> Response:
    view: View = request.app.state.view

    async def events() -> AsyncIterator[str]:
        seen, silent, ends = -1.0, 0, False
        while not (ends or await request.is_disconnected()):
            # once more when the server stops, so that the page shows that the daemon has stopped
            ends = request.app.state.ends()
            changed = view.changed()
            silent += 1
            # the same status again, too: its age tells that the daemon was killed
            if changed != seen or silent >= _ALIVE_EVERY:
                seen, silent = changed, 0
                document = await asyncio.to_thread(view.shown)
                yield f"data: {json.dumps(document)}\n\n"
            if not ends:
                await asyncio.sleep(_STREAM_EVERY_S)

    return StreamingResponse(events(), media_type="text/event-stream")


def _columns(view: View, request: Request) -> dict[str, Any]:
    camera, series = _camera_and_series(request)
    since = _number(request, "last", 1.0, 1e10)
    points = _number(request, "points", 2.0, 2000.0)
    return view.columns(camera, series, since, int(points or 1000))


def _csv(view: View, request: Request) -> Response:
    camera, series = _camera_and_series(request)
    text = view.csv(camera, series)
    head = next(text)  # an error is answered before the table begins
    name = re.sub(r"[^\w.-]", "-", f"{camera}-{series}.csv", flags=re.ASCII)  # fits into a header
    return StreamingResponse(
        chain([head], text),
        media_type="text/csv",
        headers={"content-disposition": f'attachment; filename="{name}"'},
    )


def _health(view: View, _: Request) -> Response:
    healthy, why = view.healthy()
    return JSONResponse({"ok": healthy, "why": why}, 200 if healthy else 503)


# path → function that returns an answer, or a document for one as JSON
_ANSWERS: dict[str, Callable[[View, Request], Any]] = {
    "/healthz": _health,
    "/metrics": lambda view, _: Response(
        generate_latest(SimpleNamespace(collect=lambda: _families(view.status()))),
        media_type="text/plain; version=0.0.4; charset=utf-8",
    ),
    "/api/status": lambda view, _: view.shown(),
    "/api/series": lambda view, _: view.series(),
    "/api/series.csv": _csv,
    "/api/columns": _columns,
    "/api/events": lambda view, _: view.events(),
    "/api/cameras/{camera}/epoch": lambda view, r: view.last_epoch(r.path_params["camera"]),
    "/api/cameras/{camera}/frame": lambda view, r: Response(
        view.last_frame(r.path_params["camera"]), media_type="image/jpeg"
    ),
    "/camera.json": lambda view, r: view.current_camera(r.query_params.get("camera")),
    "/camera.yaml": lambda view, r: Response(
        view.camera_info(r.query_params.get("camera")), media_type="application/yaml"
    ),
}


def _answer(read: Callable[[View, Request], Any], request: Request) -> Response:
    found = read(request.app.state.view, request)
    return found if isinstance(found, Response) else JSONResponse(found)


def _camera_and_series(request: Request) -> tuple[str, str]:
    found = []
    for key in ("camera", "series"):
        value = request.query_params.get(key, "")
        if not value or len(value) > LONGEST_NAME or not value.isprintable():
            raise UsageError(f"{key}: give a name of at most {LONGEST_NAME} characters")
        found.append(value)
    return found[0], found[1]


def _number(request: Request, key: str, low: float, high: float) -> float | None:
    text = request.query_params.get(key)
    if text is None:
        return None
    try:
        # float() also accepts 1_0 and the digits of every script
        value = float(text[:40]) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise UsageError(f"{key}: must be a number from {low:g} to {high:g}")
    return value
