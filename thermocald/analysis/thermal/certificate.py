"""A thermal model for its reader: as lines of text, and as a certificate in HTML.

The certificate says how the camera changes with temperature, and over which range. Its answer gives
the largest rate with its standard deviation; tables list the model and its evidence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from thermocald.figures import Curve, Figure, Panel
from thermocald.numbers import UNITS, celsius, parameter_label, percent, signed, with_sd
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.physics.formula import say_together
from thermocald.physics.model import SURE
from thermocald.report import Answer, Chapter, Section, Table, as_sentence
from thermocald.store.recording.sense import doubt_lines
from thermocald.thermal.criteria import NEGLIGIBLE_PX, SIGNIFICANT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor


_UNSEEN = 0.5
"""A parameter with a larger weight of the type counts as the type's."""


def describe_small_misfit(document: Mapping[str, Any]) -> str:
    """Return what a significant misfit is that is too small to be a missing effect, "" if none."""
    sigmas, left = document.get("significance_sigmas") or 0.0, document.get("misfit_px") or 0.0
    if document.get("effect_missing") or sigmas < SIGNIFICANT or left < NEGLIGIBLE_PX:
        return ""
    return (
        f"smooth trajectories of {left:.3f} px ({sigmas:.0f} standard deviations), small beside "
        "the noise; the standard deviations of predicted image points include them, but single "
        "rates may be wrong by several of theirs"
    )


def model_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the lines for a document of `thermocald fit`; the first is the camera's name."""
    lines = [str(document["camera"])]
    lines += _verdict_lines(document)
    sure = document.get("distortion_sigmas")
    if sure is not None and document["distortion"] == "image":
        lines.append(
            f"  the distortion keeps its place in the image, not its angle ({sure:.1f} sd)"
        )
    elif sure is not None and sure < SURE:
        lines.append(
            "  the distortion is assumed to follow the angle while c changes; the data cannot "
            f"distinguish it from one that keeps its place in the image ({abs(sure):.1f} sd)"
        )
    if "type" in document:
        kind = document["type"]
        lines.append(f"  combined with the type {kind['name']} ({kind['cameras']} cameras)")
    for name, rate in document["rates"].items():
        lines.append(f"  {name:>4}: {_shown(rate, 'µm/K', 1e3)}")
    lines += [f"  {doubt}" for doubt in _find_doubtful(document)]
    for effect in document["effects"]:
        parts = [
            f"{k} = {_shown(v, v['unit'])}"
            for k, v in effect["parameters"].items()
            if isinstance(v, dict)
        ]
        lines.append(f"  {effect['effect']}: {', '.join(parts)}")
    lines += [f"    {say_together(known)}" for known in document.get("known_together", ())]
    lines += [
        f"  {s['name']}: {s['epochs']} epochs"
        + ("" if s["means"] is None else f" on {s['means']} means")
        + f", {s['rms_px']:.4f} px left over beside {s['noise_px']:.4f} px of noise, "
        f"thermometer ± {s['thermometer_sd']:.3f} K"
        for s in document.get("series", ())
    ]
    lines += [
        f"  {c['calibration']}: {c['photographs']} photographs at {celsius(c['temperature'])} °C, "
        f"the model's image is {c['rms_px']:.4f} px away"
        for c in document.get("calibrations", ())
    ]
    lines += [
        f"  {h['name']} left out: predicted to {h['rms_px']:.4f} px (noise alone "
        f"{h['floor_px']:.4f}), {h['object_mm']:.2f} mm at 10 m"
        for h in document.get("prediction_test", ())
    ]
    lines += [f"  {line}" for line in doubt_lines(document.get("doubts", ()))]
    return [part for line in lines for part in line.split("\n")]


def _verdict_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the temperatures of the fit, and whether an effect is missing."""
    lines = []
    T0 = f"T0 = {celsius(document['reference_temperature'])} °C"
    within = f"at unstated temperatures, {T0}"
    for low, high in document["validity"].values():
        within = f"from {celsius(low)} to {celsius(high)} °C, {T0}"
    if why := document.get("not_examined"):
        left = document["left_over_in_noise"]
        lines.append(f"  not examined whether an effect is missing: {why}")
        lines.append(
            f"  fitted {within}; what is left over is {left:.1f} times the noise"
            + ("" if document["band"] else ": no 95 % band is stated")
        )
    elif document.get("effect_missing") and document.get("calibrations"):
        lines.append(
            f"  the calibrations differ by {document['sigma0']:.1f} times what their standard "
            "deviations allow: parameters other than c, x0, y0 change with temperature, or the "
            f"change is not linear\n  fitted {within}; standard "
            "deviations are widened by that"
        )
    elif document.get("effect_missing"):
        cause = "an effect is missing"
        if document.get("trembles"):
            cause += ", or the mount moves: all targets jump together from epoch to epoch"
        lines.append(
            f"  {cause}: the model leaves {document['misfit_px']:.3f} px in smooth "
            f"trajectories ({document['significance_sigmas']:.0f} standard deviations); "
            "run: thermocald discover\n"
            f"  fitted {within}; standard deviations are widened by what "
            "is left, and no 95 % band is stated"
        )
    else:
        lines.append(f"  valid {within}")
        if left := describe_small_misfit(document):
            lines.append(f"  left over: {left}; thermocald discover looks for the cause")
    return lines


def _find_doubtful(document: Mapping[str, Any]) -> list[str]:
    """Return a sentence on each number whose standard deviation is not its own, or too small."""
    said = []
    weights = document["type"]["weights"] if "type" in document else {}
    if unseen := [name for name, weight in weights.items() if weight > _UNSEEN]:
        said.append(
            f"these recordings show little of {', '.join(unseen)}: value and standard "
            "deviation are the type's; record the change between two temperatures, too"
        )
    if hang := document.get("rates_hang_on_c"):
        said.append(
            f"the field hardly determines c (to {percent(hang['c_known_to'], 2)}), and the rates "
            "depend on it: they may be wrong by several of their standard deviations; use a field "
            "with depth, such as three walls that meet"
        )
    if seldom := document.get("read_seldom"):
        said.append(
            f"{', '.join(seldom['effects'])}: how the temperature turns between two readings is "
            "not known, and times may be wrong by several standard deviations; read the "
            "thermometer more often"
        )
    if poorly := document.get("read_poorly"):
        said.append(
            f"{', '.join(poorly['effects'])}: the thermometer is too noisy or too coarse for the "
            "changes between its readings: values may be wrong by several standard deviations; "
            "use a better thermometer or heat faster"
        )
    return said


_DISTANCE_MM = 10_000.0


def render_certificate(
    document: Mapping[str, Any], sensor: Sensor, limits: tuple[float, float],
    drift: Figure | None, warning: str, title: str,
) -> str:  # fmt: skip
    """Return the page as HTML text.

    document: of the thermal camera; limits: the range of its temperatures, °C; drift: over it;
    warning: the camera's; title: "" for the camera's name.
    """
    low, high = limits
    left = describe_small_misfit(document)
    left = f"left over: {left}" if left else "no smooth trajectories are left beyond the noise"
    examined = document.get("misfit_px") is not None
    missing = bool(document.get("effect_missing"))
    series = ", ".join(str(s["name"]) for s in document.get("series", ()))
    return Chapter(
        title or f"Thermal model of {document['camera']}",
        Answer(
            _sentence(document, sensor.pixel_pitch, low, high),
            drift,
            (as_sentence(warning or left),) if examined else (),
            ("Find the missing effect: thermocald discover.",) if missing
            else ("Correct measurements with: thermocald correct.",),
            (
                f"Temperatures below {low:.0f} and above {high:.0f} °C.",
                "A change of focus or lens after the series: calibrate again.",
                "Errors of the camera model itself, which no standard deviation here includes.",
            ),
        ),
        tuple(
            Section(heading, tables=tuple(table for table in tables if table.rows))
            for heading, tables in (
                ("The model", _model_tables(document)),
                ("Evidence", _evidence_tables(document)),
            )
        ),
        about=(f"{sensor}{f'; fitted to {series}' if series else ''}.",),
        notes=tuple(map(as_sentence, [
            *_find_doubtful(document), *doubt_lines(document.get("doubts", ()))
        ])),
    ).page()  # fmt: skip


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


def drift_figure(T: Array, T0: float, changes: Array, half: Array | None) -> Figure:
    """Draw the changes (n, 10) since T0 of the steady camera against temperatures (n,) °C.

    half (n, 10): of the width of their 95 % bands; None for a model that misses an effect.
    """
    panels = []
    for name in ("c", "x0", "y0"):
        k, label = IOP_NAMES.index(name), parameter_label(name)
        curve = Curve("", T, 1e3 * changes[:, k], half=None if half is None else 1e3 * half[:, k])
        panels.append(Panel(label, "temperature in °C", f"Δ{label} in µm", (curve,)))
    return Figure(
        "drift", "Change of the camera with its temperature",
        f"Each parameter minus its value at {celsius(T0)} °C, at steady temperatures; "
        f"{'no band is given' if half is None else 'bands: 95 %'}.",
        tuple(panels),
    )  # fmt: skip


def _shown(entry: Mapping[str, Any], unit: str, scale: float = 1.0) -> str:
    return with_sd(scale * entry["value"], scale * entry.get("sd", float("nan")), unit)


def _model_tables(document: Mapping[str, Any]) -> list[Table]:
    rates = document["rates"]
    effects = [
        (effect["effect"], name, entry)
        for effect in document["effects"]
        for name, entry in effect["parameters"].items()
        if isinstance(entry, dict)
    ]
    return [
        Table.of(
            "Interior orientation",
            document["interior"].items(),
            {
                "parameter": lambda r: parameter_label(r[0]),
                f"at {celsius(document['reference_temperature'])} °C": lambda r: _shown(
                    r[1], UNITS.get(r[0], "")
                ),
                "rate": lambda r: _shown(rates[r[0]], "µm/K", 1e3) if r[0] in rates else "",
            },
        ),
        Table.of(
            "Effects",
            effects,
            {
                "effect": lambda r: str(r[0]),
                "parameter": lambda r: parameter_label(r[1]) if r[1] in IOP_NAMES else str(r[1]),
                "value ± sd": lambda r: _shown(r[2], "" if r[2]["unit"] == "1" else r[2]["unit"]),
            },
        ),
    ]


def _evidence_tables(document: Mapping[str, Any]) -> list[Table]:
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
