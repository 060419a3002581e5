"""Effects of the lens and the sensor: expansion, distortion, focus."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.physics.effect import Steady, coefficient_units
from thermocald.physics.formula import Proportional

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.physics.effect import Prediction, Values
    from thermocald.physics.history import History


class NonlinearExpansion(Proportional):
    """A signal a (T - T₀)² in c, x0, y0.

    Source: the second-order temperature coefficients of length and of refractive index, e.g. Schott
    TIE-19: Temperature Coefficient of the Refractive Index.
    """

    name = "nonlinear_expansion"
    noun = "a quadratic expansion"
    formula = "square(offset(T, T0))"
    linear: Mapping[str, str] = coefficient_units("K2")
    steady_signal = Steady((0.0, 0.0, 1.0))
    behaviour: Mapping[str, str] = {
        "hold": "does not move while the temperature is constant",
        "cycle": "runs along the same curve up and down",
        "hotter": "keeps bending at every temperature",
        "rate": "shows the same curve at any rate",
        "idle": "does nothing",
    }


class RadialDistortionDrift(Proportional):
    """A signal a (T - T₀) in A1 (A2, A3)."""

    name = "radial_distortion_drift"
    noun = "a drift of the radial distortion"
    linear: Mapping[str, str] = coefficient_units("K", ("A1", "A2", "A3"))
    usual = ("A1",)
    parameter_sets = (("A1",), ("A1", "A2"), ("A1", "A2", "A3"))
    behaviour: Mapping[str, str] = {
        **Proportional.behaviour, "turn": "stays radial about the principal point"
    }  # fmt: skip


class DecenteringDrift(Proportional):
    """A signal a (T - T₀) in B1, B2."""

    name = "decentering_drift"
    noun = "a drift of the decentering distortion"
    linear: Mapping[str, str] = coefficient_units("K", ("B1", "B2"))
    usual = ("B1", "B2")
    behaviour: Mapping[str, str] = {**Proportional.behaviour, "turn": "turns with the camera"}


class AffinityDrift(Proportional):
    """A signal a (T - T₀) in C1, C2: the axes' difference in scale, and their shear."""

    name = "affinity_drift"
    noun = "a drift of the affinity"
    linear: Mapping[str, str] = coefficient_units("K", ("C1", "C2"))
    usual = ("C1", "C2")
    behaviour: Mapping[str, str] = {
        **Proportional.behaviour, "turn": "turns with the camera, along the sensor axes"
    }  # fmt: skip


class Defocus(Proportional):
    """A factor max(1 + k (T - T₀), 0.1) on measuring noise and blur; positions stay unbiased.

    Noise and blur share the factor: the standard deviation of an edge grows between the root of its
    blur (Cramér-Rao) and in proportion to it (an operator of fixed width), and an instrument with
    fixed windows is close to the latter.
    """

    name = "defocus"
    noun = "defocus"
    says = "heat defocuses: the measuring noise grows by {factor}"
    kind = "image"
    linear: Mapping[str, str] = {"factor": "1/K"}
    usual = ("factor",)
    seen_in = "noise"
    behaviour: Mapping[str, str] = {
        "hold": "leaves the positions unchanged and the noise constant",
        "cycle": "makes the noise rise and fall with the temperature",
    }

    def influence(self, history: History, values: Values, found: Prediction) -> None:
        factor = np.maximum(1.0 + values["factor"] * self.signal(history)[:, 0], 0.1)
        found.noise_factor *= factor
        found.blur_factor *= factor
