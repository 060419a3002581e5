"""The certificate of a thermal model: how a camera changes with temperature, over which range.

Its answer gives the largest rate with its standard deviation; tables list the model and its
evidence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.thermal.model_text import describe_small_misfit
from thermocald.figures import BAND, Curve, Figure, Panel
from thermocald.numbers import UNITS, parameter_label, signed, with_sd
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.report import Answer, Chapter, Section, Table, as_sentence
from thermocald.store.recording.sense import doubt_lines

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.analysis.camera.camera import Camera
    from thermocald.arrays import Array

_DISTANCE_MM = 10_000.0


def render_certificate(
    document: Mapping[str, Any], states: Sequence[Camera], title: str = ""
) -> str:
    """Return the page as HTML text.

    document: of the thermal camera; states: the camera at temperatures over the range, in order;
    title: by default the camera's name.
    """
    sensor, T = states[0].sensor, np.array([state.temperature for state in states])
    low, high = T[[0, -1]].tolist()
    values = np.array([state.interior.as_array() for state in states])
    sds = np.array([[state.sd.get(name, 0.0) for name in IOP_NAMES] for state in states])
    missing = bool(document.get("effect_missing"))
    series = ", ".join(str(s["name"]) for s in document.get("series", ()))
    return Chapter(
        title or f"Thermal model of {document['camera']}",
        Answer(
            _sentence(document, sensor.pixel_pitch, low, high),
            _drift(T, values, sds, missing),
            (_assess_misfit(document),),
            ("Find the missing effect: thermocald discover.",) if missing
            else ("Correct measurements with: thermocald correct.",),
            (
                f"Temperatures below {low:.0f} and above {high:.0f} °C.",
                "A change of focus or lens after the series: calibrate again.",
                "Errors of the camera model itself, which no standard deviation here includes.",
            ),
        ),
        (
            _section("The model", _values(document), _effects(document)),
            _section("Evidence", *_evidence(document)),
        ),
        about=(f"{sensor}{f'; fitted to {series}' if series else ''}.",),
        notes=tuple(as_sentence(line) for line in doubt_lines(document.get("doubts", ()))),
    ).page()  # fmt: skip


def _section(title: str, *tables: Table) -> Section:
    return Section(title, tables=tuple(table for table in tables if table.rows))


def _sentence(document: Mapping[str, Any], pitch: float, low: float, high: float) -> str:
    """State the largest rate with its sd, the range, and the effect of both on a plane at 10 m."""
    rates = {n: (r["value"], r.get("sd", float("nan"))) for n, r in document["rates"].items()}
    if not rates:
        return f"The camera does not change with temperature between {low:.0f} and {high:.0f} °C."
    name = max(rates, key=lambda n: abs(rates[n][0]))
    rate, sd = rates[name]
    text = (
        f"{parameter_label(name)} moves by {signed(rate / pitch, sd / pitch, 'px/K')} between "
        f"{low:.0f} and {high:.0f} °C"
    )
    if name != "c":
        c = document["interior"]["c"]["value"]
        per_rate = (high - low) / c * _DISTANCE_MM
        text += f", in all {with_sd(abs(rate) * per_rate, sd * per_rate, 'mm')} at 10 m"
    return f"{text}."


def _assess_misfit(document: Mapping[str, Any]) -> str:
    if why := document.get("not_examined"):
        return f"Whether an effect is missing was not examined: {why}."
    if document.get("effect_missing"):
        left = document.get("misfit_px")
        size = "" if left is None else f" of {left:.3f} px"
        return (
            f"An effect is missing: the residuals have smooth trajectories{size}. They are "
            "included in the standard deviations, and no 95 % band is given."
        )
    if left := describe_small_misfit(document):
        return f"Left over: {left}."
    return "The residuals have no smooth trajectories beyond the noise."


def _drift(T: Array, values: Array, sds: Array, missing: bool) -> Figure:
    middle = len(T) // 2
    panels = []
    for name in ("c", "x0", "y0"):
        k = IOP_NAMES.index(name)
        y, half = 1e3 * (values[:, k] - values[middle, k]), 1e3 * BAND * sds[:, k]
        curve = Curve("", T, y, half=None if missing else half)
        label = parameter_label(name)
        panels.append(Panel(label, "temperature in °C", f"Δ{label} in µm", (curve,)))
    band = "no band is given" if missing else "bands: 95 %, with the uncertainty of the level"
    return Figure(
        "drift", "Change of the camera with its temperature",
        "Each parameter minus its value in the middle of the range, at steady temperatures; "
        f"{band}.",
        tuple(panels),
    )  # fmt: skip


def _shown(entry: Mapping[str, Any], unit: str, scale: float = 1.0) -> str:
    return with_sd(scale * entry["value"], scale * entry.get("sd", float("nan")), unit)


def _values(document: Mapping[str, Any]) -> Table:
    rates = document["rates"]
    return Table.of(
        "Interior orientation",
        document["interior"].items(),
        {
            "parameter": lambda r: parameter_label(r[0]),
            f"at {document['reference_temperature']:g} °C": lambda r: _shown(
                r[1], UNITS.get(r[0], "")
            ),
            "rate": lambda r: _shown(rates[r[0]], "µm/K", 1e3) if r[0] in rates else "",
        },
    )


def _effects(document: Mapping[str, Any]) -> Table:
    found = [
        (effect["effect"], name, entry)
        for effect in document["effects"]
        for name, entry in effect["parameters"].items()
        if isinstance(entry, dict)
    ]
    return Table.of(
        "Effects",
        found,
        {
            "effect": lambda r: str(r[0]),
            "parameter": lambda r: str(r[1]),
            "value ± sd": lambda r: _shown(r[2], "" if r[2]["unit"] == "1" else r[2]["unit"]),
        },
    )


def _evidence(document: Mapping[str, Any]) -> list[Table]:
    return [
        Table.of(
            "Series",
            document.get("series", ()),
            {
                "series": lambda s: str(s["name"]),
                "epochs": lambda s: str(s["epochs"]),
                "residual px RMS": lambda s: f"{s['rms_px']:.4f}",
                "noise px": lambda s: f"{s['noise_px']:.4f}",
                "thermometer ± K": lambda s: f"{s['thermometer_sd']:.3f}",
            },
        ),
        Table.of(
            "Each series predicted from the others",
            document.get("prediction_test", ()),
            {
                "series": lambda s: str(s["name"]),
                "error px RMS": lambda s: f"{s['rms_px']:.4f}",
                "noise alone px": lambda s: f"{s['floor_px']:.4f}",
                "mm at 10 m": lambda s: f"{s['object_mm']:.2f}",
            },
        ),
    ]
