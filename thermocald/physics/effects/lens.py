"""Effects of the lens and the sensor: expansion, distortion, focus."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.physics.effect import Proportional, Steady, coefficient_units

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.physics.effect import Prediction, Values
    from thermocald.physics.history import History


class NonlinearExpansion(Proportional):
    """Adds a (T - T₀)² to c, x0, y0.

    Source: the second coefficient of length and of refractive index against temperature, e.g.
    Schott TIE-19: Temperature Coefficient of the Refractive Index.
    """

    name = "nonlinear_expansion"
    noun = "a quadratic expansion"
    power = 2
    linear: Mapping[str, str] = coefficient_units("K2")
    steady_signal = Steady((0.0, 0.0, 1.0))
    behaviour: Mapping[str, str] = {
        "hold": "does not move while the temperature stands",
        "cycle": "runs along the same curve up and down",
        "hotter": "keeps bending at every temperature",
        "rate": "shows the same curve at any rate",
        "idle": "does nothing",
    }


class RadialDistortionDrift(Proportional):
    """Adds a (T - T₀) to A1 (A2, A3)."""

    name = "radial_distortion_drift"
    noun = "a drift of the radial distortion"
    linear: Mapping[str, str] = coefficient_units("K", ("A1", "A2", "A3"))
    usual = ("A1",)
    parameter_sets = (("A1",), ("A1", "A2"), ("A1", "A2", "A3"))
    behaviour: Mapping[str, str] = {
        **Proportional.behaviour, "turn": "stays radial about the principal point"
    }  # fmt: skip


class DecenteringDrift(Proportional):
    """Adds a (T - T₀) to B1, B2."""

    name = "decentering_drift"
    noun = "a drift of the decentering distortion"
    linear: Mapping[str, str] = coefficient_units("K", ("B1", "B2"))
    usual = ("B1", "B2")
    behaviour: Mapping[str, str] = {**Proportional.behaviour, "turn": "turns with the camera"}


class AffinityDrift(Proportional):
    """Adds a (T - T₀) to C1, C2: scale difference of the axes and their shear."""

    name = "affinity_drift"
    noun = "a drift of the affinity"
    linear: Mapping[str, str] = coefficient_units("K", ("C1", "C2"))
    usual = ("C1", "C2")
    behaviour: Mapping[str, str] = {
        **Proportional.behaviour, "turn": "turns with the camera, along the sensor axes"
    }  # fmt: skip


class Defocus(Proportional):
    """Measuring noise and blur are multiplied by max(1 + k (T - T₀), 0.1); positions stay unbiased.

    Noise and blur share the factor: the precision of an edge falls between the root of its blur
    (Cramér-Rao) and in proportion to it (an operator of fixed width), and an instrument of fixed
    windows lies at the latter.
    """

    name = "defocus"
    noun = "defocus"
    says = "heat defocuses: the measuring noise grows by {factor}"
    kind = "image"
    linear: Mapping[str, str] = {"factor": "1/K"}
    usual = ("factor",)
    seen_in = "noise"
    behaviour: Mapping[str, str] = {
        "hold": "leaves positions alone; noise stays as large as it is",
        "cycle": "makes noise come and go with the temperature",
    }

    def influence(self, history: History, values: Values, found: Prediction) -> None:
        factor = np.maximum(1.0 + values["factor"] * self.signal(history)[:, 0], 0.1)
        found.noise_factor *= factor
        found.blur_factor *= factor
