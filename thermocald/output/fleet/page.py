"""The page of a fleet: one HTML file that works offline, for a desk and for a telephone.

What somebody should look at comes first; then every camera in a table, and of each type the rates
of its specimens, so that an odd one is seen and not only named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.durations import short_duration
from thermocald.output.page import render_page

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["render_fleet"]

_TEMPLATE = Path(__file__).parent / "templates" / "fleet.html.j2"
_WORDS = {
    "late": "late",
    "sensor": "dead sensor",
    "calibrate": "needs calibration",
    "odd": "unlike its type",
    "clock": "wrong clock",
    "refused": "rows refused",
}
_NORMAL_95 = 1.96
_WIDTH, _LEFT, _ROW, _TOP = 420.0, 120.0, 18.0, 8.0
_THIN_ROW, _MOST_LABELLED, _TICK = 5.0, 40, 45.0


@dataclass(frozen=True, slots=True)
class _Dot:
    """A specimen's rate in the drawing, px; label: empty where there are too many."""

    x: float
    low: float
    high: float
    y: float
    label: str
    title: str
    odd: bool


@dataclass(frozen=True, slots=True)
class _Drawing:
    """The rates of a type's specimens, from the lowest to the highest."""

    title: str
    height: float
    dots: tuple[_Dot, ...]
    mean: float
    band: tuple[float, float]
    ticks: tuple[tuple[float, str], ...]


def render_fleet(document: Mapping[str, Any], made: datetime | None = None) -> str:
    """The page as HTML text; document: of `fleet_document`; made: the time that it bears."""
    at = made or datetime.now(tz=UTC)
    summary, cameras = document["summary"], document["cameras"]
    tiles = [(str(summary["sound"]), "sound", "sound")]
    tiles += [(str(summary[kind]), word, kind) for kind, word in _WORDS.items() if summary[kind]]
    return render_page(
        _TEMPLATE,
        title=f"{summary['cameras']} cameras at {summary['stations']} stations",
        made=f"{at:%Y-%m-%d %H:%M} UTC, from {', '.join(document['servers'])}",
        tiles=tiles,
        words=_WORDS,
        found=[c for c in cameras if c["findings"]],
        rows=[_row(camera) for camera in cameras],
        types=[(kind, _drawings(kind, cameras)) for kind in document["types"]],
        width=_WIDTH,
        left=_LEFT,
    )


def _row(camera: Mapping[str, Any]) -> dict[str, str | bool]:
    low, high = camera["temperature_range"] or (math.nan, math.nan)
    rates = {
        name: f"{r['value'] * 1e3:+.3f} ± {r['sd'] * 1e3:.3f}"
        for name, r in camera["rates"].items()
    }
    return {
        "name": f"{camera['station']}/{camera['camera']}",
        "type": camera["type"],
        "last": short_duration(camera["lag_s"]),
        "way": short_duration(camera["on_the_way_s"]),
        "waiting": "–" if camera["waiting"] is None else str(camera["waiting"]),
        "ok": f"{camera['ok']:.0%}" if math.isfinite(camera["ok"]) else "–",
        "now": f"{camera['temperature']:.1f}" if math.isfinite(camera["temperature"]) else "–",
        "range": f"{low:.0f} … {high:.0f}" if math.isfinite(low) else "–",
        **{name: rates.get(name, "–") for name in ("c", "x0", "y0")},
        "sound": not camera["findings"],
    }


def _drawings(kind: Mapping[str, Any], cameras: Sequence[Mapping[str, Any]]) -> list[_Drawing]:
    of_name = {f"{c['station']}/{c['camera']}": c for c in cameras}
    specimens = [(name, of_name[name]) for name in kind["cameras"]]
    return [_drawing(rate, kind["rates"][rate], specimens) for rate in kind["rates"]]


def _drawing(
    rate: str, of_type: Mapping[str, Any], specimens: Sequence[tuple[str, Mapping[str, Any]]]
) -> _Drawing:
    mean: float = of_type["value"]
    spread: float = _NORMAL_95 * of_type["sd_between"]
    found = sorted(
        (
            c["rates"][rate]["value"],
            _NORMAL_95 * c["rates"][rate]["sd"],
            name,
            any(f["kind"] == "odd" for f in c["findings"]),
        )
        for name, c in specimens
    )
    lows = [v - half for v, half, *_ in found] + [mean - spread]
    highs = [v + half for v, half, *_ in found] + [mean + spread]
    low, high = min(lows), max(highs)
    span = (high - low) or 1e-9

    def x(value: float) -> float:
        return float(round(_LEFT + 6 + (value - low) / span * (_WIDTH - _LEFT - 16), 1))

    labelled = len(found) <= _MOST_LABELLED
    row = _ROW if labelled else _THIN_ROW
    dots = tuple(
        _Dot(
            x(value), x(value - half), x(value + half), _TOP + row * (i + 0.5),
            _short(name) if labelled else "",
            f"{name}: {value * 1e3:+.3f} ± {half / _NORMAL_95 * 1e3:.3f} µm/K", odd,
        )
        for i, (value, half, name, odd) in enumerate(found)
    )  # fmt: skip
    ticks = tuple(
        (x(v), f"{v * 1e3:+.2g}")
        for v in (low, mean, high)
        if v == mean or abs(x(v) - x(mean)) > _TICK
    )
    height = _TOP + row * len(found)
    return _Drawing(rate, height, dots, x(mean), (x(mean - spread), x(mean + spread)), ticks)


def _short(name: str) -> str:
    return name if len(name) <= 18 else f"{name[:8]}…{name[-9:]}"
