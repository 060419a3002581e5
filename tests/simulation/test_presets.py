"""The presets, compared with the reference study (Elias et al. 2020, sections 4.1 and 4.2)."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.physics.presets import PRESETS, preset_simulation

# preset: change of principal point px and of c mm, direction (right, up), from the text; share
# below 1.5 cm in %, mean cm, mean of the nine maxima cm, from table 7 and section 4.4
REFERENCE = {
    "nexus5-cold": (16, 0.007, (1, -1), 67, 1.3, 6.2),
    "nexus5-warm": (8, 0.003, (1, -1), 98, 0.6, 2.9),
    "galaxy-s8-cold": (40, 0.007, (-1, 1), 20, 3.0, 12.9),
    "galaxy-s8-warm": (11, 0.003, (-1, 1), 93, 0.8, 3.5),
    "rpi-v2.1-heating": (None, None, (-1, -1), None, 1.1, 4.5),
}


def object_errors(s, sets, rng):
    """Return distances, cm, at 10 m between the rays of drawn IOP and of the mean IOP (sets, 9)."""
    sd = s.truth.iop[:, :3].std(axis=0, ddof=1)
    c = s.model.interior.c
    sensor = s.model.sensor
    half = np.array([sensor.width - 1, sensor.height - 1]) / 2 * sensor.pixel_pitch
    gx, gy = (g.ravel() for g in np.meshgrid([-half[0], 0, half[0]], [-half[1], 0, half[1]]))
    dc, dx, dy = (rng.normal(0, v, (sets, 1)) for v in sd)
    x = ((gx - dx) / (c + dc) - gx / c) * 1000
    y = ((gy - dy) / (c + dc) - gy / c) * 1000
    return np.hypot(x, y)


@pytest.mark.parametrize("name", PRESETS)
def test_drift_and_errors_in_object_space_agree_with_the_reference(name):
    """Shares agree to 3 points, means to 0.1 cm, mean maxima to 15 %."""
    s = preset_simulation(name, seed=3)
    assert (s.programme.epochs, s.programme.interval) == (150, 10.0)
    iop, T = s.truth.iop, s.true_history.temperature()
    hottest = int(np.argmax(T))
    moved = iop[hottest] - iop[0]
    pixels, c_mm, towards, share, mean, maximum = REFERENCE[name]
    assert np.array_equal(np.sign(moved[1:3]), towards)
    assert np.abs(np.corrcoef(s.readings["temperature"], iop[:, :3].T)[0, 1:]).min() > 0.98
    found = object_errors(s, 50_000, np.random.default_rng(1))
    assert abs(found.mean() - mean) < 0.1
    assert abs(found.max(axis=0).mean() / maximum - 1) < 0.15
    if pixels is not None:  # a phone warms with a time constant of 300 s
        assert round(np.hypot(moved[1], moved[2]) / s.model.sensor.pixel_pitch) == pixels
        assert round(moved[0], 3) == c_mm
        warmed = (T - T[0]) / (PRESETS[name].end_degc - T[0])
        assert abs(np.interp(1 - np.exp(-1), warmed, s.frame_times) - 300.0) < 15.0
        assert np.all(np.diff(T) > 0)
        assert abs((found < 1.5).mean() * 100 - share) < 3.0


def test_the_rpi_returns_along_a_line_but_not_completely():
    s = preset_simulation("rpi-v2.1-heating")
    path = s.truth.iop[:, 1:3] - s.truth.iop[0, 1:3]
    length = np.linalg.norm(path, axis=1)
    hottest = int(length.argmax())
    along = path[hottest] / length[hottest]
    across = path @ np.array([-along[1], along[0]])
    assert np.abs(across).max() < 1e-3 * length[hottest]
    # the temperature's share at the end, and the permanent part
    T = s.true_history.temperature()
    cooled = (T[-1] - T[0]) / (T.max() - T[0])
    assert 0.02 < length[-1] / length[hottest] - cooled < 0.10
    factor = s.truth.noise_factor
    assert abs(factor.max() - 3.5) < 0.01
    assert abs(factor[0] - 1.0) < 1e-12
    assert int(factor.argmax()) == int(T.argmax())
