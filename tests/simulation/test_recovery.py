"""Every effect's parameters are estimated from a noisy recording within 3 sd.

The recording is written and read as a user's: 0.04 px of image noise, 2 % of targets missing, 0.2 %
gross errors, a thermometer with 0.04 K of noise and 0.0625 K steps, read up to 1 s before or after
the frame. The fit is the user's (`analysis.thermal_model`), which searches the whole range of
non-linear parameters.
"""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.physics import catalogue
from thermocald.physics.device import CameraDevice, Programme
from thermocald.physics.heat import Course
from thermocald.physics.model import ModelEffect
from thermocald.physics.simulation import Simulation
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.recording.reader import read_recording
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import series_input

# effects of about a third of a pixel; the fit begins at their parameters' defaults
TRUE = {
    "thermal_lag": {"tau": 84.0},
    "time_offset": {"d": 12.0},
    "hysteresis": {"half_width": 0.8},
    "nonlinear_expansion": {"c": 1e-6, "x0": 4e-6, "y0": -3e-6},
    "softening": {"T_k": 36.0, "c": 2e-5, "x0": 8e-5, "y0": 4e-5},
    "thermal_gradient": {"c": 2e-3, "x0": 8e-3, "y0": -5e-3},
    "permanent_set": {"c": 1e-5, "x0": 4e-5, "y0": 3e-5},
    "self_heating": {"tau": 260.0, "c": 2e-4, "x0": 6e-4, "y0": -4e-4},
    "creep": {"c": 1e-7, "x0": 4e-7, "y0": -2e-7},
    "slip": {"time": 803.0, "c": 1e-4, "x0": 6e-4, "y0": 2e-4},
    "cyclic_interference": {"P": 143.0, "phase": 0.9, "c": 5e-5, "x0": 4e-4, "y0": -2e-4},
    "second_heat_source": {"channel": "board_temperature", "c": 2e-5, "x0": 8e-5, "y0": -5e-5},
    "defocus": {"factor": 0.08},
    "housing_tilt": {"omega": 4e-6, "phi": -6e-6, "kappa": 3e-6},
    "mount_motion": {"tau": 200.0, "omega": 4e-6, "phi": -6e-6, "kappa": 3e-6, "X0": 4e-3,
                     "Z0": -3e-3},
    "radial_distortion_drift": {"A1": 6e-6},
    "decentering_drift": {"B1": 4e-6, "B2": -3e-6},
    "affinity_drift": {"C1": 6e-6, "C2": -4e-6},
    "test_field_expansion": {"X": 1.2e-5, "Y": 2e-5, "Z": -1e-5},
    "target_displacement": {"time": 905.0, "targets": ("x33", "y52"), "dX": 0.15, "dY": -0.1,
                            "dZ": 0.2},
}  # fmt: skip


def record(tmp_path, effect, seed=8):
    """Record 180 epochs of 10 s with a lamp twice on and off, and a processor that sometimes works.

    The lens follows slowly enough for straight lines between readings. Otherwise no estimate from
    these readings could be right within its standard deviation.
    """
    field = demonstration_field("plain")
    model = demonstration_model(field).with_effect(effect)
    device = CameraDevice("rpi", model.sensor)
    lamp = Course.steps([0, 100, 600, 1000, 1400, 1e4], [0.0, 12.0, 0.0, 15.0, 0.0])
    board = Course.polygon([0, 300, 650, 1100, 1500, 1e4], [0.5, 3.0, 0.8, 4.0, 1.0, 1.0])
    programme = Programme(
        "lamp", 180, 10.0, {"ambient": Course.constant(23.0)}, {"housing": lamp, "board": board}
    )
    simulation = Simulation(model, device, field, programme, seed)
    simulation.write(tmp_path / "M1")
    return simulation, read_recording(tmp_path / "M1")


def test_every_effect_is_here():
    assert set(TRUE) == set(catalogue.names())


@pytest.mark.slow
@pytest.mark.parametrize("name", TRUE)
def test_parameters_are_recovered(tmp_path, name):
    true, kind = TRUE[name], catalogue.get(name)
    simulation, recording = record(tmp_path, ModelEffect(name, true))
    series = reduce_series(series_input(recording), strict=False)
    start = {k: true[k] if p.text else p.default for k, p in kind.nonlinear.items()}
    start = ModelEffect(name, {**dict.fromkeys(kind.usual, 0.0), **start})
    fitted = fit_thermal_model([series], [start], T0=simulation.model.T0)
    (found,) = fitted.model.effects
    for key, value in true.items():
        if isinstance(value, str | tuple):
            continue
        sd = found.sds[key]
        assert 0 < sd < np.inf
        # an event is anywhere between two frames: ± half an interval, √12/2 of its sd
        limit = np.sqrt(3.0) * sd * (1 + 1e-9) if key == "time" else 3 * sd
        assert abs(found.values[key] - value) <= limit, (key, found.values[key], value, sd)
    for key in ("c", "x0", "y0"):
        error = fitted.model.rates[key] - simulation.model.rates[key]
        assert abs(error) < 3 * fitted.model.sd(f"rates.{key}"), key
    assert abs(fitted.fitted["sigma0"] - 1.0) < 0.03 or name == "defocus"
    if name == "thermal_lag":
        # the thermometer's noise with its steps, from the image points alone: a lag of 8 epochs
        # leaves some 180 / 8 independent values, so 3 sd are 45 %
        noise = fitted.fitted["series"][0].thermometer_sd / np.hypot(0.04, 0.0625 / 12**0.5)
        assert abs(noise - 1) < 0.45
        assert sd < 10.0 / 3.0
