"""A fitted thermal camera as readable lines."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from thermocald.numbers import with_sd
from thermocald.physics.formula import say_together
from thermocald.physics.model import SURE
from thermocald.store.recording.sense import doubt_lines
from thermocald.thermal.criteria import NEGLIGIBLE_PX, SIGNIFICANT

if TYPE_CHECKING:
    from collections.abc import Mapping


_UNSEEN = 0.5
"""A parameter with a larger weight of the type counts as the type's."""
_UNKNOWN = {"": (math.nan, math.nan)}


def describe_small_misfit(document: Mapping[str, Any]) -> str:
    """Return what a significant misfit is that is too small to be a missing effect, "" if none."""
    sigmas, left = document.get("significance_sigmas") or 0.0, document.get("misfit_px") or 0.0
    if document.get("effect_missing") or sigmas < SIGNIFICANT or left < NEGLIGIBLE_PX:
        return ""
    return (
        f"smooth trajectories of {left:.3f} px ({sigmas:.0f} standard deviations), small beside "
        "the noise; the standard deviations include them"
    )


def model_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the lines for a document of `thermocald fit`; the first is the camera's name."""
    lines = [str(document["camera"])]
    low, high = next(iter((document["validity"] or _UNKNOWN).values()))
    T0 = f"T0 = {document['reference_temperature']:g} °C"
    if why := document.get("not_examined"):
        left = document["left_over_in_noise"]
        lines.append(f"  not examined whether an effect is missing: {why}")
        lines.append(
            f"  fitted from {low:g} to {high:g} °C, {T0}; what is left over is {left:.1f} times "
            "the noise" + ("" if document["band"] else ": no 95 % band is stated")
        )
    elif document.get("effect_missing") and document.get("calibrations"):
        lines.append(
            f"  the calibrations differ by {document['sigma0']:.1f} times what their standard "
            "deviations allow: parameters other than c, x0, y0 change with temperature, or the "
            f"change is not linear\n  fitted from {low:g} to {high:g} °C, {T0}; standard "
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
            f"  fitted from {low:g} to {high:g} °C, {T0}; standard deviations are widened by what "
            "is left, and no 95 % band is stated"
        )
    else:
        lines.append(f"  valid from {low:g} to {high:g} °C, {T0}")
        if left := describe_small_misfit(document):
            lines.append(f"  left over: {left}; thermocald discover looks for the cause")
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
        if unseen := [name for name, weight in kind["weights"].items() if weight > _UNSEEN]:
            lines.append(
                f"  these recordings show little of {', '.join(unseen)}: value and standard "
                "deviation are the type's; record the change between two temperatures, too"
            )
    for name, rate in document["rates"].items():
        shown = with_sd(1e3 * rate["value"], 1e3 * rate.get("sd", math.nan), "µm/K")
        lines.append(f"  {name:>4}: {shown}")
    if hang := document.get("rates_hang_on_c"):
        lines.append(
            f"  the field hardly determines c (to {hang['c_known_to']:.2%}), and the rates depend "
            "on it: they may be wrong by several of their standard deviations; use a field with "
            "depth, such as three walls that meet"
        )
    if seldom := document.get("read_seldom"):
        lines.append(
            f"  {', '.join(seldom['effects'])}: how the temperature turns between two readings is "
            "not known, and times may be wrong by several standard deviations; read the "
            "thermometer more often"
        )
    if poorly := document.get("read_poorly"):
        lines.append(
            f"  {', '.join(poorly['effects'])}: the thermometer is too noisy or too coarse for the "
            "changes between its readings: values may be wrong by several standard deviations; "
            "use a better thermometer or heat faster"
        )
    for effect in document["effects"]:
        parts = [
            f"{k} = {with_sd(v['value'], v.get('sd', math.nan), v['unit'])}"
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
        f"  {c['calibration']}: {c['photographs']} photographs at {c['temperature']:.1f} °C, "
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
