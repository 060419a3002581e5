"""What none of the catalogue explains, described by everything that was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.reduction.series import COLUMNS

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.discovery.search.examination import Examination
    from thermocald.reduction.adequacy import Adequacy
    from thermocald.reduction.series import ReducedSeries

__all__ = ["Description", "describe_unnamed"]

_NEARLY = 0.95  # of the movement that the named parameters have to make
_WORTH = 0.02  # of the movement that one more has to add
# a shift of the image is told by the principal point before it is told by a tilt
_IN_ORDER = (range(3), range(3, 10), range(10, 16), range(16, len(COLUMNS)))


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
    """Time series, spatial pattern and correlations of what the base model leaves in M1.

    Its size is what it moves the image points by, in px, and its parameters are the fewest whose
    movement of the image is nearly all of it.
    """
    a, e = x.base_adequacy[0], x.fitter.series[0]
    rest = a.trajectories.T @ a.amplitudes  # (E, P), px-scaled
    rest = rest - rest.mean(axis=0)
    seen = e.columns[e.weights[..., 0].any(axis=0)].reshape(-1, rest.shape[1])
    metric = seen.T @ seen / len(seen)
    moved = rest.T @ rest / len(rest)
    size = float(np.sqrt(np.sum(metric * moved)))
    values, vectors = np.linalg.eigh(metric)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    u, s, _ = np.linalg.svd(rest @ root, full_matrices=False)
    course_px = u[:, 0] * s[0]
    direction = rest.T @ u[:, 0] / s[0]
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
    power = np.sum(a.scores**2, axis=1)
    order = int(np.argmax(power)) + 1
    duration = float(e.times[-1] - e.times[0])
    most = np.abs(course_px - course_px.mean())
    large = np.flatnonzero(most > 0.5 * most.max())
    parameters = _movers(metric, moved)
    strongest = max(correlation, key=lambda k: abs(correlation[k]))
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
            "size": {"value": size, "sd": size / float(np.sqrt(max(a.excess, 1.0))), "unit": "px"},
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


def _movers(metric: Array, moved: Array) -> list[str]:
    """The fewest parameters that move the image by nearly all that is left, interior ones first.

    metric (P, P): mean products of the image's partial derivatives; moved (P, P): mean products of
    the rest.
    """
    total = float(np.sum(metric * moved))
    chosen: list[int] = []
    explained = 0.0
    for group in _IN_ORDER:
        left = [i for i in group if metric[i, i] > 0]
        while left and explained < _NEARLY * total:
            gains = []
            for i in left:
                some = [*chosen, i]
                inner = inverse_of_determined(metric[np.ix_(some, some)])
                gains.append(float(np.sum((metric[:, some] @ inner @ metric[some]) * moved)))
            best = int(np.argmax(gains))
            if gains[best] < explained + _WORTH * total:
                break
            explained = gains[best]
            chosen.append(left.pop(best))
    return [COLUMNS[i] for i in chosen]


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
