"""The page of a fleet: what somebody should look at, every camera, and the rates of each type.

The rates of a type's specimens are drawn together, so that an odd one is seen and not only named.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from thermocald.figures import BAND, PALETTE, drawing_style, label_axes, new_drawing
from thermocald.numbers import parameter_label, short_duration, shortened
from thermocald.report import (
    Answer,
    Chapter,
    Drawing,
    Section,
    Table,
    of_drawing,
    render_report,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from datetime import datetime

_WORDS = {
    "late": "late",
    "sensor": "dead sensor",
    "calibrate": "needs calibration",
    "odd": "unlike its type",
    "clock": "wrong clock",
    "refused": "rows refused",
}
_COUNTED = _WORDS | {
    "sensor": "with a dead sensor",
    "calibrate": "in need of calibration",
    "odd": "unlike their type",
    "clock": "with a wrong clock",
    "refused": "with refused rows",
}
_ADVICE = {
    "late": "Late stations: look at their power and network.",
    "sensor": "Dead sensors: exchange the thermometer; the frames go on.",
    "calibrate": "Cameras beyond their calibrated range: record there and fit again.",
    "odd": "Cameras unlike their type: look whether the lens or the mount is loose.",
    "clock": "Wrong clocks: let the station synchronise before its temperatures are used.",
    "refused": "Refused rows: see the finding for the reason.",
}
_MOST_LABELLED = 40


def render_fleet(document: Mapping[str, Any], made: datetime | None = None) -> str:
    """Return the page as HTML text; document: of `fleet_document`; made: the time it bears."""
    summary, cameras = document["summary"], document["cameras"]
    found = tuple(
        (f"{_name(c)}, {_WORDS[f['kind']]}", f["text"]) for c in cameras for f in c["findings"]
    )
    counts = [f"{summary[kind]} {word}" for kind, word in _COUNTED.items() if summary[kind]]
    drawn = [
        (kind, _drawings(number, kind, cameras)) for number, kind in enumerate(document["types"])
    ]
    proof = drawn[0][1].pop(0) if drawn and drawn[0][1] else None
    title = f"{summary['cameras']} cameras at {summary['stations']} stations"
    answer = Answer(
        f"{summary['sound']} of {summary['cameras']} cameras are sound"
        + (f"; {', '.join(counts)}." if counts else "."),
        proof=proof,
        next_steps=tuple(text for kind, text in _ADVICE.items() if summary[kind]),
        not_covered=(
            (
                "Rates are straight lines with their standard deviations, from epochs spread over "
                "all that a camera has measured: they compare specimens. A model to correct with "
                "is made by thermocald fit."
            ),
        ),
    )
    sections = [
        *([Section("To look at", items=found)] if found else []),
        Section("Cameras", tables=(_table(cameras),)),
        *(
            Section(f"Type {kind['type']}: {len(kind['cameras'])} cameras", figures=tuple(figures))
            for kind, figures in drawn
        ),
    ]
    about = (f"From {', '.join(document['servers'])}.",)
    return render_report(title, [Chapter(title, answer, tuple(sections), about)], made=made)


def _name(camera: Mapping[str, Any]) -> str:
    return f"{camera['station']}/{camera['camera']}"


def _table(cameras: Sequence[Mapping[str, Any]]) -> Table:
    rates = tuple(f"{parameter_label(name)} µm/K" for name in ("c", "x0", "y0"))
    return Table(
        "Every camera",
        ("station/camera", "last epoch", "on its way", "waiting", "results", "°C now",
         "°C calibrated", *rates, "type"),
        tuple(_row(camera) for camera in cameras),
        "●: see above.",
    )  # fmt: skip


def _row(camera: Mapping[str, Any]) -> tuple[str, ...]:
    low, high = camera["temperature_range"] or (math.nan, math.nan)
    rates = {
        name: f"{r['value'] * 1e3:+.3f} ± {r['sd'] * 1e3:.3f}"
        for name, r in camera["rates"].items()
    }
    return (
        f"{'● ' if camera['findings'] else ''}{_name(camera)}",
        short_duration(camera["lag_s"]),
        short_duration(camera["on_the_way_s"]),
        "–" if camera["waiting"] is None else str(camera["waiting"]),
        f"{camera['ok']:.0%}" if math.isfinite(camera["ok"]) else "–",
        f"{camera['temperature']:.1f}" if math.isfinite(camera["temperature"]) else "–",
        f"{low:.0f} … {high:.0f}" if math.isfinite(low) else "–",
        *(rates.get(name, "–") for name in ("c", "x0", "y0")),
        camera["type"],
    )


def _drawings(
    number: int, kind: Mapping[str, Any], cameras: Sequence[Mapping[str, Any]]
) -> list[Drawing]:
    of_name = {_name(c): c for c in cameras}
    specimens = [(name, of_name[name]) for name in kind["cameras"]]
    return [
        _drawing(f"type-{number}-{rate}", rate, kind["rates"][rate], specimens)
        for rate in kind["rates"]
    ]


def _drawing(
    name: str, rate: str, of_type: Mapping[str, Any],
    specimens: Sequence[tuple[str, Mapping[str, Any]]],
) -> Drawing:  # fmt: skip
    """A type's specimens, from the lowest rate to the highest, in the band of the type."""
    found = sorted(
        (
            1e3 * c["rates"][rate]["value"],
            1e3 * BAND * c["rates"][rate]["sd"],
            specimen,
            any(f["kind"] == "odd" for f in c["findings"]),
        )
        for specimen, c in specimens
    )
    mean, spread = 1e3 * of_type["value"], 1e3 * BAND * of_type["sd_between"]
    labelled = len(found) <= _MOST_LABELLED
    with drawing_style():
        drawing = new_drawing(7.0, 0.9 + (0.2 if labelled else 0.05) * len(found))
        axis = drawing.subplots()
        axis.axvspan(mean - spread, mean + spread, color=PALETTE[0], alpha=0.12, lw=0)
        axis.axvline(mean, color=PALETTE[0], lw=1)
        for place, (value, half, _, odd) in enumerate(found):
            axis.errorbar(value, place, xerr=half, fmt="o", ms=3, lw=1.2,
                          color=PALETTE[1] if odd else "#333333")  # fmt: skip
        axis.set_yticks(
            range(len(found)) if labelled else [],
            [shortened(specimen, 26) for *_, specimen, _ in found] if labelled else [],
        )
        axis.grid(visible=False, axis="y")
        label_axes(axis, f"{parameter_label(rate)} in µm/K")
        if not labelled:
            label_axes(axis, y="cameras, lowest first")
    return of_drawing(
        drawing, name, f"{parameter_label(rate)} of each camera",
        "Bars and band: 95 %, of each camera and of the type; line: the type's mean; orange: "
        "unlike its type.",
    )  # fmt: skip
