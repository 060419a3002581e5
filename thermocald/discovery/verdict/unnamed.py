"""What none of the catalogue explains, described by everything that was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.reduction.adequacy import names_of
from thermocald.reduction.series import COLUMNS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.discovery.search.examination import Examination
    from thermocald.reduction.adequacy import Adequacy
    from thermocald.reduction.series import ReducedSeries

    Array = NDArray[np.float64]

__all__ = ["Description", "describe_unnamed"]


@dataclass(frozen=True, eq=False)
class Description:
    """Statement, where, estimates and evidence of an unnamed influence; trajectory (E,) px RMS, its
    direction (P,) in px-scaled columns.
    """

    statement: str
    where: dict[str, Any]
    estimates: dict[str, dict[str, Any]]
    evidence: dict[str, Any]
    trajectory: Array
    direction: Array


def describe_unnamed(x: Examination) -> Description:
    """Time series, spatial pattern and correlations of what the base model leaves in M1."""
    a, e = x.base_adequacy[0], x.fitter.series[0]
    u, s, v = np.linalg.svd(a.scores, full_matrices=False)
    norms = np.linalg.norm(a.trajectories, axis=1)
    trajectory = (u[:, 0] * s[0] / norms) @ a.trajectories
    direction = a.directions @ v[0]
    image = np.einsum("tij,j->ti", e.columns, direction)
    pattern = float(np.sqrt(np.mean(image[e.weights[..., 0].any(axis=0)] ** 2)))
    course_px = trajectory * pattern
    T = e.history.temperature()  # on all epochs; the rows may be blocks of them
    recorded: dict[str, Array] = {
        "temperature": e.averaged(T),
        "rate of temperature": e.averaged(np.gradient(T, e.history.times)),
        "time": e.times,
        "sigma0": e.sigma0,
    }
    for name in e.history.readings:
        if name != e.history.reference:
            recorded[name] = e.averaged(e.history.temperature(name))
    correlation = {
        name: float(np.corrcoef(course_px, values)[0, 1])
        for name, values in recorded.items()
        if np.std(values) > 0
    }
    shares = names_of(a.directions, a.scores)
    power = np.sum(a.scores**2, axis=1)
    order = int(np.argmax(power)) + 1
    duration = float(e.times[-1] - e.times[0])
    most = np.abs(course_px - course_px.mean())
    large = np.flatnonzero(most > 0.5 * most.max())
    parameters = [name for name, share in shares if share > 0.1][:5]
    strongest = max(correlation, key=lambda k: abs(correlation[k]))
    size = float(np.sqrt(np.mean((course_px - course_px.mean()) ** 2)))
    statement = (
        f"something that no effect of the catalogue explains moves the image by {size:.3f} px RMS, "
        f"in {', '.join(parameters)}; strongest correlation {correlation[strongest]:+.2f} with "
        f"{strongest}. A smooth term bridges it in this series alone"
    )
    return Description(
        statement,
        {
            "parameters": parameters,
            "epochs": [int(e.numbers[large[0]]), int(e.numbers[large[-1]])],
            "image_region": None,
        },
        {
            "size": {"value": size, "sd": size / max(float(s[0]), 1.0), "unit": "px"},
            "time_scale": {"value": duration / order, "sd": duration / order / 4, "unit": "s"},
        },
        {
            "correlation": correlation,
            "share_of_first_pattern": float(s[0] ** 2 / np.sum(s**2)),
            "significance_sigmas": float(a.significance),
            "bridge": _bridge(a, e),
        },
        course_px,
        direction,
    )


def _bridge(a: Adequacy, e: ReducedSeries) -> dict[str, Any]:
    """What takes the rest up in this series alone: amplitudes of cos(k π t / duration), k = 1, 2, …
    with t from the first frame, in each parameter's own unit.
    """
    amplitudes = a.amplitudes / e.scale
    moving = [(i, name) for i, name in enumerate(COLUMNS) if amplitudes[:, i].any()]
    return {
        "transferable": False,
        "recording": e.source.name,
        "duration_s": float(e.times[-1] - e.times[0]),
        "cosines": {name: [float(v) for v in amplitudes[:, i]] for i, name in moving},
    }
