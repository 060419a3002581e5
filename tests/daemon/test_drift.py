"""The drift that outputs receive: in px from the start of the series, with its sd."""

from __future__ import annotations

import numpy as np

from thermocald.daemon.series_run import START_EPOCHS, drift_columns


def test_drift_in_pixels_against_the_start(daemon, measured):
    """Regression: of a new series, the first epoch counted twice in the start."""
    daemon.run(**measured)
    daemon.until(lambda: len(daemon.results()) > START_EPOCHS)
    daemon.stop()
    told = daemon.results()[: START_EPOCHS + 1]
    mean = sum(row["c"] for row in told[:START_EPOCHS]) / START_EPOCHS
    known = [row["drift_c_px"] for row in told if row["drift_c_px"] is not None]
    last = [(row["c"] - mean) / told[0]["pixel_pitch"] for row in told[START_EPOCHS - 1 :]]
    assert np.allclose(known, last, rtol=0, atol=1e-6)


def test_the_sd_holds_against_scatter():
    rng, errors, names = np.random.default_rng(3), [], ("c", "x0", "y0")
    sds = {f"sd_{name}": 2e-4 for name in names}
    for _ in range(400):
        drawn = 3.04 + 2e-4 * rng.normal(size=START_EPOCHS + 1)
        *start, last = ({"status": "ok", **dict.fromkeys(names, c), **sds} for c in drawn)
        drift = drift_columns(last, start, 0.001)
        errors.append(drift["drift_x0_px"] / drift["sd_drift_x0_px"])
    assert 0.9 < np.std(errors) < 1.1
    bad = drift_columns({**last, "status": "no_frame"}, start, 0.001)
    assert np.isnan([value for name, value in bad.items() if "drift" in name]).all()
