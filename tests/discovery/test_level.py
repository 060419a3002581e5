"""The level of a discovered model: its sds include both noises and the test field's errors."""

import numpy as np
import pytest

from tests.analysis.test_thermal_model import misread
from thermocald.discovery.result import estimate_level
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import make_known_term
from thermocald.thermal.noise import calibrate_thermometers
from thermocald.thermal.reduce import reduce_series


def pulls(draws: int, noise: float, field: float) -> np.ndarray:
    """Return the errors of c, x0, y0 at T0 over their sds (draws, 3)."""
    out = []
    for seed in range(draws):
        s, source = misread(seed, 40, noise, field)
        reduced = reduce_series(source, 30.0)
        fitter = HypothesisFitter(calibrate_thermometers([reduced]))
        fit = fitter.refine(fitter.fit((make_known_term("thermal_lag", {"tau": 70.0}, 1),)))
        level, sd = estimate_level(fitter, fit)
        truth = s.model.interior.as_array() + (30.0 - s.model.T0) * s.model.rate_vector
        found = reduced.at.iop + (level / reduced.scale[:16])[:10]
        out.append((found - truth)[:3] / (sd / reduced.scale[:16])[:3])
    return np.array(out)


@pytest.mark.parametrize(("noise", "field"), [(0.1, 0.02), (1.0, 1e-4)])
def test_the_level_is_as_sure_as_stated(noise, field):
    """Without the field's and the thermometer's part, errors are 12 and 3 times the sds.

    Over 200 draws: the sections `thermal` and `discovery` of benchmarks.audit.
    """
    spread = np.sqrt(np.mean(pulls(6, noise, field) ** 2))
    assert 0.5 < spread < 1.6
