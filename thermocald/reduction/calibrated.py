"""The noise of the reference thermometer as the images confirm it.

The readings' own roughness is the estimate of `thermometer`; the images follow the temperature
through the linear terms and are sharper than most thermometers, so that they can confirm it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.reduction.blocks import in_blocks
from thermocald.reduction.fit import HypothesisFitter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Mask
    from thermocald.reduction.series import ReducedSeries

__all__ = ["calibrated_thermometers"]


def calibrated_thermometers(series: Sequence[ReducedSeries]) -> list[ReducedSeries]:
    """The series with the noise of the reference thermometer as the images confirm it.

    The images tell the temperature too, through the linear terms: with an unknown slow error, but
    sharper than most thermometers. Where a fast effect spoils that, the readings alone count. One
    thermometer has one noise.
    """
    fitter = HypothesisFitter([in_blocks(e) for e in series])
    fit = fitter.fit(())
    fitter = HypothesisFitter(series)
    d = fit.direction(fit.blocks[0])[0]
    variances, weights = [], []
    for s, e in enumerate(series):
        instrument = e.thermometers[e.history.reference]
        precision = np.einsum("p,epq,q->e", d, e.N, d)
        ok = precision > 0
        own = instrument.noise**2
        alike = _alike(e, ok)
        if alike.sum() > 18:
            trajectory = fitter.drive_trajectory((), s)
            matrix = e.history.temperature_matrix() @ instrument.mixing
            shown = trajectory + matrix @ instrument.deviation
            # what the image says of T beyond its level, in K
            rest = (e.b @ d)[ok] / precision[ok] - shown[ok]
            image = 6.0 * float(np.mean(1.0 / precision[ok][1:-1][alike]))
            shown_by_image = (_clipped(np.diff(rest, 2)[alike]) ** 2 - image) / 6.0
            if shown_by_image < 1.5 * own:
                own = max(0.5 * (own + shown_by_image), 0.25 * own)
        variances.append(own)
        weights.append(float(ok.sum()))
    noise = float(np.sqrt(np.average(variances, weights=weights)))
    out = []
    for e in series:
        name = e.history.reference
        old = e.thermometers[name]
        ratio = noise / old.noise
        channels = {**e.thermometers, name: replace(old, sd=old.sd * ratio, noise=noise)}
        out.append(replace(e, thermometers=channels))
    return out


def _alike(series: ReducedSeries, ok: Mask) -> Mask:
    """Which of the rows with a result (n - 2,) are like both neighbours.

    In a long series that was condensed the usual mean among its like: short means are as noisy as
    their neighbours are sharp.
    """
    counts = series.source.counts
    if counts is None:
        return np.ones(max(int(ok.sum()) - 2, 0), dtype=bool)
    usual = counts[ok] == np.median(counts[ok])
    return np.asarray(usual[:-2] & usual[1:-1] & usual[2:])


def _clipped(values: Array) -> float:
    """Standard deviation of a normal distribution whose tails are spoiled."""
    scale = float(np.sqrt(np.mean(values**2)))
    for _ in range(20):
        kept = values[np.abs(values) <= 2.2 * scale]
        scale = float(np.sqrt(np.mean(kept**2))) / 0.9162 if len(kept) > 5 else scale
    return scale
