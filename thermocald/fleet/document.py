"""The overview of a fleet as one document: what `thermocald fleet` prints, writes and draws."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from typing import TYPE_CHECKING, Any

from thermocald.fleet.overview import CameraOverview, add_findings, camera_types, read_overview
from thermocald.numbers import short_duration
from thermocald.store.server.connection import ServerAddress

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_WIDTH = 80
_MOST_SOUND = 40
_LONGEST_NAME = 34
_KINDS = ("late", "sensor", "calibrate", "odd", "clock", "refused", "twins")


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


def fleet_lines(document: dict[str, Any]) -> list[str]:
    """Return the lines that `fleet` prints of a document."""
    cameras = document["cameras"]
    if not cameras:
        return ["no epochs there yet; stations send theirs with `thermocald forward`"]
    summary = document["summary"]
    words = {
        "late": "late", "sensor": "with a dead sensor", "calibrate": "need calibration",
        "odd": "unlike their type", "clock": "with a wrong clock", "refused": "with refused rows",
    }  # fmt: skip
    parts = [f"{summary[kind]} {text}" for kind, text in words.items() if summary[kind]]
    head = (
        f"{summary['cameras']} cameras at {summary['stations']} stations: {summary['sound']} sound"
    )
    lines = textwrap.wrap(", ".join([head, *parts]), _WIDTH)
    shown = [c for c in cameras if c["findings"]]
    shown += [c for c in cameras if not c["findings"]][:_MOST_SOUND]
    name = min(_LONGEST_NAME, max(14, *(len(_name(c)) for c in shown)))
    heads = f"{'last':>7} {'waiting':>7} {'ok':>5} {'°C':>6} {'c µm/K':>16}"
    lines += ["", f"{'station/camera':<{name}} {heads}"]
    for camera in shown:
        lines.append(_row(camera, name))
        for finding in camera["findings"]:
            lines += textwrap.wrap(
                finding["text"],
                _WIDTH,
                initial_indent=f"  {finding['kind']}: ",
                subsequent_indent="      ",
            )
    if hidden := len(cameras) - len(shown):
        lines.append(f"and {hidden} more without a finding (--json has them all)")
    for kind in document["types"]:
        rate = kind["rates"]["c"]
        lines += textwrap.wrap(
            f"type {kind['type']}: {len(kind['cameras'])} cameras, c {rate['value'] * 1e3:+.3f} ± "
            f"{rate['sd'] * 1e3:.3f} µm/K, between cameras ± {rate['sd_between'] * 1e3:.3f}",
            _WIDTH,
            subsequent_indent="  ",
        )
    return lines


def _row(camera: dict[str, Any], width: int) -> str:
    rate = camera["rates"].get("c")
    text = "–" if rate is None else f"{rate['value'] * 1e3:+.3f} ± {rate['sd'] * 1e3:.3f}"
    waiting = "–" if camera["waiting"] is None else str(camera["waiting"])
    ok = "–" if not math.isfinite(camera["ok"]) else f"{camera['ok']:.0%}"
    degrees = camera["temperature"]
    return (
        f"{_shortened(_name(camera), width):<{width}} {short_duration(camera['lag_s']):>7} "
        f"{waiting:>7} {ok:>5} {'–' if not math.isfinite(degrees) else f'{degrees:.1f}':>6} "
        f"{text:>16}"
    )


def _name(camera: dict[str, Any]) -> str:
    return f"{camera['station']}/{camera['camera']}"


def _shortened(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"
