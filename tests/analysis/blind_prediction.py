"""Blind recordings, fitted on M1 and tested on M2 with the user's commands.

The noise floor is from the generator's noise, not from the fit's estimate: 0.04 px (more with
`defocus`), and a reading's 0.04 K and steps of 0.0625 K propagated through the model. What readings
every 10 s leave unknown (a lamp switched between two of them, a temperature after the last one) is
part of the floor of `thermal_gradient` and `time_offset`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tests.blind.case import SINGLE, Case
from tests.blind.generator import generate, write
from tests.commands import succeed
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.physics.model import ModelEffect
from thermocald.physics.model_file import read_model
from thermocald.store.recording.reader import read_recording
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import series_input

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.physics.model import ThermalModel

__all__ = ["SINGLE", "Tested", "effect_option", "pooled", "predict_case"]

READING_SD = float(np.hypot(0.04, 0.0625 / np.sqrt(12.0)))


@dataclass(frozen=True)
class Tested:
    """A tested case: RMS on M2 over the true floor, and the share inside the stated 95 % bands."""

    effect: str
    seed: int
    ratio: float
    coverage: float
    rms_px: float


def effect_option(name: str, truth: dict) -> list[str]:
    """Return the option with which a user who knows the effect would give it."""
    if name == "second_heat_source":
        return ["--effect", f"{name}:channel=board_temperature"]
    if name == "target_displacement":
        hidden = truth["effects"][0][0]["targets"]
        return ["--effect", f"{name}:targets=" + "+".join(str(t + 1) for t in hidden)]
    if name == "radial_distortion_drift":
        return ["--effect", f"{name}:A1,A2"]
    return ["--effect", name] if name != "none" else []


def predict_case(
    name: str, seed: int, folder: Path, px: float = 0.3, discover: bool = False
) -> Tested:
    """Fit M1 with the true effect (`discover`: with those that discovery finds), and test on M2."""
    series, truth = generate(Case((name,) if name != "none" else (), px, seed))
    for s in series:
        write(s, folder / s.name)
    model = folder / "camera.yaml"
    listed = effect_option(name, truth)
    if discover:
        succeed("discover", folder / "M1", "--model-out", folder / "found.yaml", "--json", "-")
        listed = ["--model", folder / "found.yaml"]
    succeed("fit", folder / "M1", "-o", model, *listed, "--json", "-")
    done = succeed("predict", "--model", model, "--test", folder / "M2", "--json", "-")
    stated = json.loads(done.stdout)
    (tested,) = stated["series"]
    fitted = read_model(model)
    source = series_input(read_recording(folder / "M2"))
    second = reduce_series(source, strict=False)
    true = predicted_error(_with_true_noise(fitted, truth), second, READING_SD)
    rms_px = tested["rms_px"]
    return Tested(name, seed, rms_px / true.floor_px, tested["coverage"], rms_px)


def pooled(cases: list[Tested]) -> tuple[float, float]:
    """Return the RMS of the ratios, and the mean coverage."""
    ratios = np.array([c.ratio for c in cases])
    return float(np.sqrt(np.mean(ratios**2))), float(np.mean([c.coverage for c in cases]))


def _with_true_noise(model: ThermalModel, truth: dict) -> ThermalModel:
    sigma, listed = 0.04, []
    for effect in model.effects:
        if effect.name == "defocus":
            hidden = truth["effects"][0][0]
            rise = hidden["per_kelvin_above_coldest"]
            at_t0 = 1.0 + rise * (model.T0 - hidden["coldest"])
            sigma, effect = sigma * at_t0, ModelEffect("defocus", {"factor": rise / at_t0})
        listed.append(effect)
    return replace(model, image_sigma=sigma, effects=tuple(listed))
