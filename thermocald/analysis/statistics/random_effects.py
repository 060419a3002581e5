"""Specimens of one type: their mean, the scatter between them, and a new one shrunk towards them.

Specimen i has the true values θᵢ = μ + uᵢ, uᵢ ~ N(0, Σ), and an estimate bᵢ with covariance Cᵢ. The
variances of u come from Paule and Mandel's equation (1982), one parameter at a time; correlations
from the standardised differences, shrunk towards zero after Schäfer and Strimmer (2005), since ten
specimens cannot determine a full matrix. Everything is normal and conjugate: no sampling.

The uncertainty of Σ from few specimens is included: it adds to the covariance of a new specimen
(Kackar and Harville 1984), and intervals are those of a mixture over the possible Σ. This holds for
each parameter; for a sum of two parameters whose differences are highly correlated, and a new
specimen with next to no information of its own, 95 % were 93 % with ten specimens.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array

_FEWEST_FOR_CORRELATIONS = 4
_STEP = 0.05
_NODES = 49  # of the mixture over Σ
_LEVEL = 0.95  # of intervals


@dataclass(frozen=True, slots=True, eq=False)
class Shrunk:
    """A specimen's values shrunk towards its type.

    values (k,), covariance (k, k); own (k, k): the information of its own observations; push (k,):
    the gradient that moves the values away from the mean; correlations (k, k): the part of the
    covariance from the errors of Σ's correlations.
    """

    values: Array
    covariance: Array
    population: Population
    own: Array
    push: Array
    correlations: Array

    def interval(self, direction: Array) -> tuple[float, float, float]:
        """Return value, low and high of direction·θ with 95 % confidence; direction (k,).

        The interval is that of a mixture over factors of Σ, distributed as freedom / χ². A factor
        changes the value, not only its variance: a Σ too small by chance shrinks too much.
        """
        from scipy.optimize import brentq
        from scipy.special import chdtri, ndtr

        people = self.population
        quantiles = (np.arange(_NODES) + 0.5) / _NODES
        middles, variances = np.empty(_NODES), np.empty(_NODES)
        for i, factor in enumerate(people.freedom / chdtri(people.freedom, quantiles)):
            covariance = _posterior(people.prior * factor, self.own)
            middles[i] = direction @ (people.mean + covariance @ self.push)
            variances[i] = direction @ (covariance + self.correlations) @ direction
        value = float(direction @ self.values)
        sds, off = np.sqrt(np.maximum(variances, 1e-300)), value - middles

        def excess(half: float) -> float:
            low, high = ((off + end) / sds for end in (-half, half))
            return float(np.mean(ndtr(high) - ndtr(low))) - _LEVEL

        furthest = float(np.max(2 * np.abs(off) + 40 * sds))
        half = float(brentq(excess, 0.0, furthest, xtol=1e-9 * furthest))
        return value, value - half, value + half


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """A type: mean (k,) with covariance (k, k), and Σ: `between` (k, k).

    correlation_variance (k, k): expected squared error of each correlation in Σ; freedom: degrees
    of freedom of Σ.
    """

    mean: Array
    mean_covariance: Array
    between: Array
    correlation_variance: Array
    freedom: float

    @property
    def prior(self) -> Array:
        """The covariance (k, k) of one more specimen's true values."""
        return self.between + self.mean_covariance

    def posterior(self, values: Array, information: Array, gradient: Array | None = None) -> Shrunk:
        """Return a new specimen from its own estimate, shrunk towards the type.

        values (k,): its estimate, any number for an undetermined parameter; information (k, k): the
        inverse of its covariance, zero for an undetermined parameter; gradient (k,): of its own
        observations at `values`, if these are not their optimum.
        """
        known = np.where(np.diag(information) > 0, values, 0.0)
        push = information @ (known - self.mean) + (0.0 if gradient is None else gradient)
        covariance = _posterior(self.prior, information)
        found = self.mean + covariance @ push

        def moved(between: Array) -> Array:
            other = _posterior(between + self.mean_covariance, information)
            return (self.mean + other @ push - found) / _STEP

        # effect of the errors of Σ on the values, after Kackar and Harville (1984): of its
        # variances, and of its correlations
        size = len(found)
        sd = np.sqrt(np.diag(self.between))
        scatter, correlations = np.zeros((size, size)), np.zeros((size, size))
        for j in range(size):
            factors = np.ones(size)
            factors[j] = 1 + _STEP / 2
            move = moved(self.between * np.outer(factors, factors))
            scatter += np.outer(move, move) * 2.0 / self.freedom
            for k in range(j):
                other = self.between.copy()
                other[[j, k], [k, j]] += _STEP * sd[j] * sd[k]
                move = moved(other)
                correlations += np.outer(move, move) * self.correlation_variance[j, k]
        return Shrunk(
            found, covariance + scatter + correlations, self, information, push, correlations
        )


def population(values: Array, covariances: Array) -> Population:
    """Estimate the type of M > 1 specimens from their values (M, k) and covariances (M, k, k)."""
    count, size = values.shape
    noise = np.einsum("ikk->ik", covariances)
    variance = np.array([_paule_mandel(values[:, j], noise[:, j]) for j in range(size)])
    weight = 1.0 / np.maximum(variance + noise, 1e-300)
    mean = (weight * values).sum(axis=0) / weight.sum(axis=0)
    standard = (values - mean) * np.sqrt(weight)
    correlation, error = _shrunk_correlation(standard)
    between = correlation * np.sqrt(np.outer(variance, variance))
    # covariance of the mean: from the specimens' scatter and their own noise
    share = weight / weight.sum(axis=0)
    total = between[None] + covariances
    mean_covariance = np.einsum("ij,ijk,ik->jk", share, total, share)
    return Population(mean, mean_covariance, between, error, count - 1.0)


def odd_specimens(values: Array, covariances: Array) -> Array:
    """Return the probabilities (M,) that a specimen of the type is as far off as each one is.

    Each is compared with the type of the others; its most distant parameter counts, corrected for
    the number of parameters.
    """
    from scipy.special import stdtr

    count, size = values.shape
    found = np.ones(count)
    for i in range(count):
        rest = np.arange(count) != i
        others = population(values[rest], covariances[rest])
        sd = np.sqrt(np.diag(others.prior) + np.diag(covariances[i]))
        p = 2 * stdtr(count - 2, -np.abs(values[i] - others.mean) / sd)
        found[i] = min(1.0, size * float(p.min()))
    return found


def _paule_mandel(values: Array, noise: Array) -> float:
    """Return the variance between specimens that gives their weighted squares the expected sum."""
    from scipy.optimize import brentq

    high = float(np.var(values, ddof=1)) * 4 + 1e-300

    def excess(variance: float) -> float:
        weight = 1.0 / np.maximum(variance + noise, 1e-300)
        mean = (weight * values).sum() / weight.sum()
        return float((weight * (values - mean) ** 2).sum() - (len(values) - 1))

    if excess(0.0) <= 0:
        return 0.0
    return float(brentq(excess, 0.0, high, xtol=1e-15 * high))


def _posterior(prior: Array, information: Array) -> Array:
    """Return (P⁻¹ + N)⁻¹ for a prior P (k, k) that may be singular."""
    scale = np.sqrt(np.maximum(np.diag(prior), 1e-300))
    p, n = prior / np.outer(scale, scale), information * np.outer(scale, scale)
    found = np.linalg.solve(np.eye(len(p)) + p @ n, p) * np.outer(scale, scale)
    return np.asarray((found + found.T) / 2)


def _shrunk_correlation(standard: Array) -> tuple[Array, Array]:
    """Return correlations (k, k) of standardised values (M, k), shrunk to 0, and squared errors."""
    count, size = standard.shape
    z = standard - standard.mean(axis=0)
    spread = np.sqrt((z**2).sum(axis=0) / (count - 1))
    z = z / np.where(spread > 0, spread, 1.0)
    products = z[:, :, None] * z[:, None, :]
    r = products.sum(axis=0) / (count - 1)
    variance = count / (count - 1) ** 3 * ((products - products.mean(axis=0)) ** 2).sum(axis=0)
    off = ~np.eye(size, dtype=bool)
    square = float((r[off] ** 2).sum())
    intensity = 1.0
    if square > 0 and count >= _FEWEST_FOR_CORRELATIONS:
        intensity = min(1.0, float(variance[off].sum()) / square)
    error = (1 - r**2) ** 2 / (count - 1) * (1 - intensity) ** 2 + (intensity * r) ** 2
    return np.where(off, (1 - intensity) * r, 1.0), np.where(off, error, 0.0)
