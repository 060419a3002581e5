"""The overview of a fleet as one document: what `thermocald fleet` prints, writes and draws."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any

from thermocald.fleet.findings import add_findings
from thermocald.fleet.overview import CameraOverview, camera_types, read_overview
from thermocald.store.server.address import ServerAddress

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

__all__ = ["fleet_document"]

_KINDS = ("late", "sensor", "calibrate", "odd", "clock", "refused")


def fleet_document(sources: Sequence[Path]) -> dict[str, Any]:
    """Everything about the cameras that some addresses select; several servers are one fleet.

    Raises UsageError, ServerGone, ServerError, StoreVersionError.
    """
    cameras: list[CameraOverview] = []
    now = 0.0
    addresses = [ServerAddress.parse(source) for source in sources]
    for address, source in zip(addresses, sources, strict=True):
        now, found = read_overview(address, source)
        cameras += found
    types = camera_types(cameras)
    add_findings(cameras, types, now)
    counts = Counter(kind for c in cameras for kind in {f.kind for f in c.findings})
    return {
        "format": "thermocald-fleet/1",
        "servers": [str(address) for address in addresses],
        "time": now,
        "cameras": [_camera(camera) for camera in cameras],
        "types": [
            {
                "type": kind.name,
                "cameras": list(kind.cameras),
                "rates": {
                    name: {
                        "value": value,
                        "sd": kind.sd_mean[name],
                        "sd_between": kind.between[name],
                        "unit": "mm/K",
                    }
                    for name, value in kind.mean.items()
                },
            }
            for kind in types
        ],
        "summary": {
            "cameras": len(cameras),
            "stations": len({c.record.station for c in cameras}),
            "epochs": sum(c.record.epochs for c in cameras),
            "sound": sum(not c.findings for c in cameras),
            **{kind: counts[kind] for kind in _KINDS},
        },
    }


def _camera(camera: CameraOverview) -> dict[str, Any]:
    record, state = camera.record, camera.state
    return {
        "station": record.station,
        "camera": record.camera,
        "type": camera.type,
        "series": record.series,
        "epochs": record.epochs,
        "results": record.results,
        "last_epoch": record.last_time,
        "lag_s": camera.lag_s,
        "on_the_way_s": camera.on_the_way_s,
        "waiting": None if state is None else state.waiting,
        "clock_s": None if state is None else state.clock,
        "version": None if state is None else state.version,
        "ok": camera.ok,
        "temperature": camera.temperature,
        "temperature_range": None if not math.isfinite(camera.range[0]) else list(camera.range),
        "rates": {
            name: {"value": rate.value, "sd": rate.sd, "unit": "mm/K"}
            for name, rate in camera.rates.items()
        },
        "shift_px": camera.shift_px,
        "odd_p": camera.odd,
        "findings": [{"kind": f.kind, "text": f.text} for f in camera.findings],
    }
