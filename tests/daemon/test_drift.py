"""The drift that outputs receive: in px from the start of the series, with its sd."""

from __future__ import annotations

import math

import numpy as np

from thermocald.daemon.camera_line import START_EPOCHS, SeriesDrift


def rows(c, sd=1e-4, status="ok"):
    return [
        {"status": status}
        | dict.fromkeys(("c", "x0", "y0"), value)
        | dict.fromkeys(("sd_c", "sd_x0", "sd_y0"), sd)
        for value in c
    ]


def test_drift_in_pixels_against_the_start():
    drift = SeriesDrift(0.001)
    seen = [drift.columns(row) for row in rows([3.04] * START_EPOCHS)]
    assert all(math.isnan(s["drift_c_px"]) for s in seen[:-1])
    (late,) = [drift.columns(row) for row in rows([3.0405])]
    assert abs(late["drift_c_px"] - 0.5) < 1e-9
    (bad,) = [drift.columns(row) for row in rows([3.05], status="no_frame")]
    assert math.isnan(bad["drift_c_px"])


def test_the_sd_holds_against_scatter():
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(400):
        drift = SeriesDrift(0.001, rows(3.04 + 2e-4 * rng.normal(size=START_EPOCHS), 2e-4))
        (last,) = [drift.columns(row) for row in rows([3.04 + 2e-4 * rng.normal()], 2e-4)]
        errors.append(last["drift_x0_px"] / last["sd_drift_x0_px"])
    assert 0.9 < np.std(errors) < 1.1
