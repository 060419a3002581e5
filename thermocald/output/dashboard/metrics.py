"""`/metrics`: the daemon's status as Prometheus reads it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_CAMERA = {
    "ticks": "Ticks of the camera's schedule.",
    "skipped": "Ticks skipped because they came too late.",
    "late_p99_s": "Lateness of ticks, 99th percentile of the last 1000, s.",
    "lost": "Ticks in which the camera gave no frame.",
    "waiting": "Epochs on their way to the store.",
    "deferred": "Epochs whose calibration was deferred.",
    "caught_up": "Epochs that were calibrated later.",
    "stored": "Epochs stored by this process.",
}
_EPOCH = {
    "epoch": "Number of the last epoch.",
    "temperature": "Reference temperature, degrees Celsius.",
    "c": "Principal distance, mm.",
    "sd_c": "Its standard deviation, mm.",
    "x0": "Principal point x, mm.",
    "sd_x0": "Its standard deviation, mm.",
    "y0": "Principal point y, mm.",
    "sd_y0": "Its standard deviation, mm.",
    "sigma0": "Standard deviation of unit weight.",
    "n_observations": "Targets measured.",
    "n_rejected": "Targets rejected.",
}
_ONLINE = {
    "drift_px_per_min": "Drift of c, x0, y0, px per minute.",
    "ready_in_s": "Time until the camera is steady, s.",
}


class _StatusCollector:
    def __init__(self, status: Mapping[str, Any]) -> None:
        self._status = status

    def collect(self) -> Iterator[GaugeMetricFamily]:
        status = self._status
        yield _single("up", "Whether a daemon answers.", float(bool(status)))
        if not status:
            return
        yield _single("status_age_s", "Age of the daemon's status, s.", status["age_s"])
        yield _single("stalled", "Devices or pipelines that hang.", len(status["stalled"]))
        store = status["store"]
        yield _single("store_ok", "Whether the store takes everything.", store["state"] == "ok")
        yield _single("store_waiting", "Epochs waiting in memory.", store["waiting"])
        yield _single("store_lost", "Epochs taken and not kept.", store["lost"])
        yield _single("clock_trusted", "Whether UTC is known.", status["clock"]["trusted"])
        up = GaugeMetricFamily("thermocald_device_up", "Open and working.", labels=["kind", "name"])
        for kind in ("cameras", "thermometers", "outputs"):
            for name, device in status[kind].items():
                up.add_metric([kind[:-1], name], float(device["device"] == "open"))
        yield up
        for names, inner in ((_CAMERA, ()), (_EPOCH, ("last",)), (_ONLINE, ("last", "online"))):
            for key, about in names.items():
                yield self._per_camera(key, about, inner)

    def _per_camera(self, key: str, about: str, inner: tuple[str, ...]) -> GaugeMetricFamily:
        family = GaugeMetricFamily(f"thermocald_{key}", about, labels=["camera", "series"])
        for name, camera in self._status["cameras"].items():
            values = camera
            for part in inner:
                values = values.get(part) or {}
            if (value := values.get(key)) is not None:
                family.add_metric([name, camera["series"]], float(value))
        return family


def _single(name: str, about: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"thermocald_{name}", about, value=float(value))


def metrics_text(status: Mapping[str, Any]) -> bytes:
    """The text format of Prometheus."""
    registry = CollectorRegistry()
    registry.register(_StatusCollector(status))
    return generate_latest(registry)
