"""A fleet as a document, as a command's output, and as a page.

It has the findings, every camera, and the rates of each type, whose specimens are drawn together so
that an odd one can be seen.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from typing import TYPE_CHECKING, Any

from thermocald.figures import BAND, PALETTE, Figure, drawing_style, label_axes, new_drawing
from thermocald.fleet.overview import add_findings, camera_types, read_overview
from thermocald.numbers import counted, parameter_label, percent, short_duration, shortened
from thermocald.report import Answer, Chapter, Section, Table
from thermocald.result import document_of
from thermocald.store.server.connection import ServerAddress

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from thermocald.store.server.fleet_reader import FleetCamera

# kind of a finding → words for one camera, for several, and what to do
_FINDINGS = {
    "late": ("late", "late", "Late: check the power and network of the station, or its daemon."),
    "sensor": ("dead sensor", "with a dead sensor",
               "Dead sensors: replace the thermometer; frames are still taken."),
    "calibrate": ("needs calibration", "in need of calibration",
                  "Cameras beyond their calibrated range: record there and fit again."),
    "odd": ("unlike its type", "unlike their type",
            "Cameras unlike their type: check whether the lens or the mount is loose."),
    "clock": ("wrong clock", "with a wrong clock",
              "Wrong clocks: synchronise the station before its temperatures are used."),
    "refused": ("rows refused", "with refused rows",
                "Refused rows: see the station's log for the reason."),
    "twins": ("twin", "with a twin", "Twins: give each station its own name and store."),
}  # fmt: skip
_MOST_LABELLED = 40
_WIDTH = 80
_MOST_WITHOUT = 40  # cameras without a finding that are printed
_LONGEST_NAME = 34


def fleet_document(sources: Sequence[Path]) -> dict[str, Any]:
    """Return the document of the cameras that addresses select, on several servers as one fleet.

    Raises UsageError, ServerGone, ServerError, StoreVersionError.
    """
    cameras: list[FleetCamera] = []
    now = 0.0
    addresses = [ServerAddress.parse(source) for source in sources]
    for address, source in zip(addresses, sources, strict=True):
        now, selected = read_overview(address, source)
        cameras += selected
    types = camera_types(cameras)
    add_findings(cameras, types, now)
    counts = Counter(kind for c in cameras for kind in {f["kind"] for f in c.findings})
    return {
        "format": "thermocald-fleet/1",
        "servers": [str(address) for address in addresses],
        "time": now,
        "cameras": [document_of(camera) for camera in cameras],
        "types": types,
        "summary": {
            "cameras": len(cameras),
            "stations": len({c.station for c in cameras}),
            "epochs": sum(c.epochs for c in cameras),
            "sound": sum(not c.findings for c in cameras),
            **{kind: counts[kind] for kind in _FINDINGS},
        },
    }


def fleet_lines(document: dict[str, Any]) -> list[str]:
    """Return the lines that `fleet` prints for a document."""
    cameras = document["cameras"]
    if not cameras:
        return ["no epochs there yet; stations send theirs with `thermocald forward`"]
    summary = document["summary"]
    head = ", ".join([f"{_title(summary)}: {summary['sound']} without findings", *_counts(summary)])
    lines = textwrap.wrap(head, _WIDTH)
    shown = [c for c in cameras if c["findings"]]
    shown += [c for c in cameras if not c["findings"]][:_MOST_WITHOUT]
    name = min(_LONGEST_NAME, max(14, *(len(_name(c)) for c in shown)))
    heads = f"{'last':>7} {'waiting':>7} {'ok':>6} {'°C':>6} {'c µm/K':>16}"
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
        lines.append(f"and {hidden} more without findings (--json has them all)")
    for kind in document["types"]:
        rate = kind["rates"]["c"]
        lines += textwrap.wrap(
            f"type {kind['type']}: {len(kind['cameras'])} cameras, c {rate['value'] * 1e3:+.3f} ± "
            f"{rate['sd'] * 1e3:.3f} µm/K, between cameras ± {rate['sd_between'] * 1e3:.3f}",
            _WIDTH,
            subsequent_indent="  ",
        )
    return lines


def _title(summary: Mapping[str, int]) -> str:
    return f"{counted(summary['cameras'], 'camera')} at {counted(summary['stations'], 'station')}"


def _counts(summary: Mapping[str, int]) -> list[str]:
    return [
        f"{summary[kind]} {words}" for kind, (_, words, _) in _FINDINGS.items() if summary[kind]
    ]


def _rate(camera: Mapping[str, Any], name: str) -> str:
    rate = camera["rates"].get(name)
    return f"{rate['value'] * 1e3:+.3f} ± {rate['sd'] * 1e3:.3f}" if rate else "–"


def _known(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _row(camera: dict[str, Any], width: int) -> str:
    ok = "–" if camera["ok"] is None else percent(camera["ok"])
    return (
        f"{shortened(_name(camera), width):<{width}} {short_duration(camera['lag_s']):>7} "
        f"{_known(camera['waiting'], 'd'):>7} {ok:>6} {_known(camera['temperature'], '.1f'):>6} "
        f"{_rate(camera, 'c'):>16}"
    )


def render_fleet(document: Mapping[str, Any]) -> str:
    """Return the page of a `fleet_document` as HTML text."""
    summary, cameras = document["summary"], document["cameras"]
    findings = tuple(
        (f"{_name(c)}, {_FINDINGS[f['kind']][0]}", f["text"])
        for c in cameras
        for f in c["findings"]
    )
    counts = _counts(summary)
    drawn = [
        (kind, [_drawing(f"type-{number}-{rate}", rate, kind, cameras) for rate in kind["rates"]])
        for number, kind in enumerate(document["types"])
    ]
    proof = drawn[0][1].pop(0) if drawn and drawn[0][1] else None
    title = _title(summary)
    answer = Answer(
        f"{summary['sound']} of {summary['cameras']} cameras have no finding"
        + (f"; {', '.join(counts)}." if counts else "."),
        proof=proof,
        next_steps=tuple(text for kind, (*_, text) in _FINDINGS.items() if summary[kind]),
        not_covered=(
            (
                "Rates are slopes of straight lines with their standard deviations, from epochs "
                "spread over all that a camera has measured: they compare specimens. A model for "
                "corrections is made by thermocald fit."
            ),
        ),
    )
    sections = [
        *([Section("Findings", items=findings)] if findings else []),
        Section("Cameras", tables=(_table(cameras),)),
        *(
            Section(f"Type {kind['type']}: {len(kind['cameras'])} cameras", figures=tuple(figures))
            for kind, figures in drawn
        ),
    ]
    about = (f"From {', '.join(document['servers'])}.",)
    return Chapter(title, answer, tuple(sections), about).page()


def _name(camera: Mapping[str, Any]) -> str:
    return f"{camera['station']}/{camera['camera']}"


def _table(cameras: Sequence[Mapping[str, Any]]) -> Table:
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
            "waiting": lambda c: _known(c["waiting"], "d"),
            "results": lambda c: "–" if c["ok"] is None else percent(c["ok"]),
            "°C now": lambda c: _known(c["temperature"], ".1f"),
            "°C calibrated": calibrated,
            "c µm/K": lambda c: _rate(c, "c"),
            "x₀ µm/K": lambda c: _rate(c, "x0"),
            "y₀ µm/K": lambda c: _rate(c, "y0"),
            "type": lambda c: str(c["type"]),
        },
        "●: has findings.",
    )


def _drawing(
    name: str, rate: str, kind: Mapping[str, Any], cameras: Sequence[Mapping[str, Any]]
) -> Figure:  # fmt: skip
    """Draw the rates of a type's specimens, in order, and the type's band."""
    specimens = sorted(
        (
            1e3 * c["rates"][rate]["value"],
            1e3 * BAND * c["rates"][rate]["sd"],
            _name(c),
            any(f["kind"] == "odd" for f in c["findings"]),
        )
        for c in cameras
        if _name(c) in kind["cameras"]
    )
    of_type = kind["rates"][rate]
    mean, spread = 1e3 * of_type["value"], 1e3 * BAND * of_type["sd_between"]
    labelled = len(specimens) <= _MOST_LABELLED
    with drawing_style():
        drawing = new_drawing(5.0, 0.9 + (0.2 if labelled else 0.05) * len(specimens))
        axis = drawing.subplots()
        axis.axvspan(mean - spread, mean + spread, color=PALETTE[0], alpha=0.12, lw=0)
        axis.axvline(mean, color=PALETTE[0], lw=1)
        for place, (value, half, _, odd) in enumerate(specimens):
            axis.errorbar(value, place, xerr=half, fmt="o", ms=3, lw=1.2,
                          color=PALETTE[1] if odd else "#333333")  # fmt: skip
        axis.set_yticks(
            range(len(specimens)) if labelled else [],
            [shortened(specimen, 22) for *_, specimen, _ in specimens] if labelled else [],
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
