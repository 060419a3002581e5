"""The page of a fleet: what somebody should look at, every camera, and the rates of each type.

The rates of a type's specimens are drawn together, so that an odd one is seen and not only named.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from thermocald.figures import BAND, PALETTE, Figure, drawing_style, label_axes, new_drawing
from thermocald.numbers import parameter_label, percent, short_duration, shortened
from thermocald.report import Answer, Chapter, Section, Table, render_report

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

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


def render_fleet(document: Mapping[str, Any]) -> str:
    """Return the page as HTML text; document: of `fleet_document`."""
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
    return render_report(title, [Chapter(title, answer, tuple(sections), about)])


def _name(camera: Mapping[str, Any]) -> str:
    return f"{camera['station']}/{camera['camera']}"


def _table(cameras: Sequence[Mapping[str, Any]]) -> Table:
    def known(value: float | None, form: str) -> str:
        return "–" if value is None else format(value, form)

    def rate(camera: Mapping[str, Any], name: str) -> str:
        found = camera["rates"].get(name)
        return f"{found['value'] * 1e3:+.3f} ± {found['sd'] * 1e3:.3f}" if found else "–"

    def calibrated(camera: Mapping[str, Any]) -> str:
        low, high = camera["temperature_range"] or (math.nan, math.nan)
        return f"{low:.0f} … {high:.0f}" if math.isfinite(low) else "–"

    return Table.of(
        "Every camera",
        cameras,
        {
            "station/camera": lambda c: f"{'● ' if c['findings'] else ''}{_name(c)}",
            "last epoch": lambda c: short_duration(c["lag_s"]),
            "on its way": lambda c: short_duration(c["on_the_way_s"]),
            "waiting": lambda c: known(c["waiting"], "d"),
            "results": lambda c: "–" if c["ok"] is None else percent(c["ok"]),
            "°C now": lambda c: known(c["temperature"], ".1f"),
            "°C calibrated": calibrated,
            "c µm/K": lambda c: rate(c, "c"),
            "x₀ µm/K": lambda c: rate(c, "x0"),
            "y₀ µm/K": lambda c: rate(c, "y0"),
            "type": lambda c: str(c["type"]),
        },
        "●: see above.",
    )


def _drawings(
    number: int, kind: Mapping[str, Any], cameras: Sequence[Mapping[str, Any]]
) -> list[Figure]:
    specimens = [c for c in cameras if _name(c) in kind["cameras"]]
    return [
        _drawing(f"type-{number}-{rate}", rate, kind["rates"][rate], specimens)
        for rate in kind["rates"]
    ]


def _drawing(
    name: str, rate: str, of_type: Mapping[str, Any], specimens: Sequence[Mapping[str, Any]]
) -> Figure:  # fmt: skip
    """A type's specimens, from the lowest rate to the highest, in the band of the type."""
    found = sorted(
        (
            1e3 * c["rates"][rate]["value"],
            1e3 * BAND * c["rates"][rate]["sd"],
            _name(c),
            any(f["kind"] == "odd" for f in c["findings"]),
        )
        for c in specimens
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
    return Figure(
        name, f"{parameter_label(rate)} of each camera",
        "Bars and band: 95 %, of each camera and of the type; line: the type's mean; orange: "
        "unlike its type.", drawing=drawing,
    )  # fmt: skip
