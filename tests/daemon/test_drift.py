"""The drift that outputs receive: in px from the start of the series, with its sd."""

from __future__ import annotations

import math

import numpy as np

from thermocald.daemon.series_run import START_EPOCHS, drift_columns


def rows(c, sd=1e-4, status="ok"):
    return [
        {"status": status}
        | dict.fromkeys(("c", "x0", "y0"), value)
        | dict.fromkeys(("sd_c", "sd_x0", "sd_y0"), sd)
        for value in c
    ]


def test_drift_in_pixels_against_the_start(daemon, measured):
    """Regression: of a new series, the first epoch counted twice in the start."""
    start = rows([3.04] * START_EPOCHS)
    late, bad = *rows([3.0405]), *rows([3.05], status="no_frame")
    assert abs(drift_columns(late, start, 0.001)["drift_c_px"] - 0.5) < 1e-9
    for row, begun in ((late, start[1:]), (bad, start)):
        assert math.isnan(drift_columns(row, begun, 0.001)["drift_c_px"])
    daemon.run(**measured)
    daemon.until(lambda: len(daemon.results()) > START_EPOCHS)
    daemon.stop()
    told = daemon.results()[: START_EPOCHS + 1]
    mean = sum(row["c"] for row in told[:START_EPOCHS]) / START_EPOCHS
    known = [row["drift_c_px"] for row in told if row["drift_c_px"] is not None]
    last = [(row["c"] - mean) / told[0]["pixel_pitch"] for row in told[START_EPOCHS - 1 :]]
    assert np.allclose(known, last, rtol=0, atol=1e-6)


def test_the_sd_holds_against_scatter():
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(400):
        start = rows(3.04 + 2e-4 * rng.normal(size=START_EPOCHS), 2e-4)
        last = drift_columns(*rows([3.04 + 2e-4 * rng.normal()], 2e-4), start, 0.001)
        errors.append(last["drift_x0_px"] / last["sd_drift_x0_px"])
    assert 0.9 < np.std(errors) < 1.1
