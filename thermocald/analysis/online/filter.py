"""The recursive estimate of one camera: an information filter over IOP, EOP and a thermal model.

The state is the orientation at T₀ and the rates of c, x0, y0 per kelvin; every epoch's adjustment
adds its information, so that after an hour a static camera's exterior orientation is known far
better than any single epoch can tell. What an epoch says beyond what was expected is its
innovation; its chi-square tells a knock, a slip of the principal point, another lens.

The thermometer's noise counts as noise of the epoch, and while the temperature changes the
prediction is trusted less: the camera may lag. Errors of the test field are common to all epochs
and not in the covariance: it is one relative to the series.

Source: Anderson and Moore (1979), Optimal Filtering, chapter 6.3 (information form); innovation
test: Bar-Shalom, Li and Kirubarajan (2001), section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment

    Array = NDArray[np.float64]

__all__ = ["FilterSettings", "Innovation", "OnlineFilter", "chi2_quantile"]

Change = Literal["", "outlier", "knock", "slip", "wrong_lens", "change"]

_WARM = (0, 1, 2)  # c, x0, y0 follow the temperature
_EOP = tuple(range(10, 16))
_OTHER_LENS = 0.02  # of c
_FAR = 1e4  # prior sd of what is not known, in sd of the first epoch


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """How the filter expects a camera to behave.

    thermometer_sd K; wander_px: of c, x0, y0 per √epoch beyond the thermal model; lag: share of a
    change of temperature that may reach the camera later; alpha: error probability of one test;
    rate_sd_px: prior sd of the rates per kelvin.
    """

    thermometer_sd: float = 0.05
    wander_px: float = 0.003
    lag: float = 0.5
    alpha: float = 1e-6
    rate_sd_px: float = 5.0


@dataclass(frozen=True, slots=True)
class Innovation:
    """One epoch against the expectation: chi-square, its bound, degrees of freedom, and what it is.

    change: "" if the epoch is as expected; "outlier" for a first surprise, which is not taken in;
    a surprise that stays is a knock (EOP), a slip (x0, y0, c), another lens, or some change.
    """

    chi2: float
    bound: float
    dof: int
    change: Change


def chi2_quantile(p: float, dof: int) -> float:
    """The chi-square quantile at probability p (Wilson and Hilferty 1931), to 4 % for dof ≥ 6.

    scipy.stats would cost the daemon 22 MB.
    """
    from statistics import NormalDist

    z = NormalDist().inv_cdf(p)
    h = 2.0 / (9.0 * dof)
    return float(dof * (1.0 - h + z * np.sqrt(h)) ** 3)


class OnlineFilter:
    """The estimate, epoch after epoch.

    Attributes: epochs taken in; T0 °C. All in the units of CONVENTIONS §2.
    """

    def __init__(self, sensor: Sensor, settings: FilterSettings | None = None) -> None:
        self.sensor = sensor
        self.settings = settings or FilterSettings()
        self.epochs = 0
        self.T0 = float("nan")
        self._free: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self._surprised = 0
        self._temperature = float("nan")

    def update(self, adjustment: Adjustment, temperature: float) -> Innovation | None:
        """Take an epoch in; None if it has no result.

        temperature: °C at the frame, NaN where it is not known: the last one then still holds.
        """
        if not adjustment.ok:
            return None
        variance = np.diag(adjustment.covariance)
        free = np.flatnonzero(variance > 0)
        if not self.epochs or not np.array_equal(free, self._free):
            self._begin(adjustment, free, temperature)
            return Innovation(0.0, 0.0, len(free), "")
        now = self._temperature if np.isnan(temperature) else temperature
        step = 0.0 if np.isnan(now - self._temperature) else now - self._temperature
        self._temperature = now
        self._predict(step)
        return self._take_in(adjustment)

    @property
    def rates(self) -> Array:
        """Rates of c, x0, y0 mm/K."""
        result: Array = (self._state() * self._scale)[len(self._free) :]
        return result

    @property
    def rates_covariance(self) -> Array:
        """(3, 3) of `rates`, mm²/K²."""
        s = self._scale[len(self._free) :]
        result: Array = self._P[len(self._free) :, len(self._free) :] * np.outer(s, s)
        return result

    def values(self) -> Array:
        """(16,) the orientation at the last temperature; what is held keeps its value."""
        out = self._held.copy()
        out[self._free] += self._H() @ self._state() * self._scale[: len(self._free)]
        return out

    def covariance(self) -> Array:
        """(16, 16) of `values`, zero where held; relative to the series."""
        H = self._H()
        s = self._scale[: len(self._free)]
        out = np.zeros((16, 16))
        out[np.ix_(self._free, self._free)] = H @ self._P @ H.T * np.outer(s, s)
        return out

    def _begin(self, adjustment: Adjustment, free: NDArray[np.int64], temperature: float) -> None:
        self._free = free
        self._held = adjustment.values.copy()
        sd = np.sqrt(np.diag(adjustment.covariance))[free]
        rate_scale = np.full(3, self.sensor.pixel_pitch)
        self._scale = np.concatenate([sd, rate_scale])
        self._warm = np.array([k for k, i in enumerate(free) if i in _WARM], dtype=np.int64)
        self._rate_of = np.array([int(free[k]) for k in self._warm], dtype=np.int64)
        n = len(free)
        self._P = np.zeros((n + 3, n + 3))
        self._P[:n, :n] = self._scaled(adjustment.covariance)
        self._P[n:, n:] = np.eye(3) * self.settings.rate_sd_px**2
        self._Y = np.linalg.inv(self._P)
        self._y = np.zeros(n + 3)
        self.T0 = temperature
        self._temperature = temperature
        self.epochs = 1
        self._surprised = 0

    def _scaled(self, covariance: Array) -> Array:
        s = self._scale[: len(self._free)]
        result: Array = covariance[np.ix_(self._free, self._free)] / np.outer(s, s)
        return result

    def _state(self) -> Array:
        result: Array = self._P @ self._y
        return result

    def _H(self) -> Array:
        """Scaled state → scaled free parameters, at the last temperature."""
        n = len(self._free)
        H = np.hstack([np.eye(n), np.zeros((n, 3))])
        dT = self._temperature - self.T0
        if np.isfinite(dT):
            for k, i in zip(self._warm, self._rate_of, strict=True):
                H[k, n + i] = dT * self._scale[n + i] / self._scale[k]
        return H

    def _rate_moment(self) -> Array:
        """E[r rᵀ] of the rates r as a column of scaled free parameters per kelvin, (n, n).

        With the rates' own covariance in it: while they are unknown, a noisy thermometer must not
        pretend to tell them.
        """
        n = len(self._free)
        state = self._state()[n:]
        moment = np.outer(state, state) + self._P[n:, n:]
        to = np.zeros((n, 3))
        for k, i in zip(self._warm, self._rate_of, strict=True):
            to[k, i] = self._scale[n + i] / self._scale[k]
        result: Array = to @ moment @ to.T
        return result

    def _predict(self, step: float) -> None:
        n = len(self._free)
        wander = self.settings.wander_px * self.sensor.pixel_pitch
        state = self._state()
        Q = np.zeros(n + 3)
        Q[self._warm] = (wander / self._scale[self._warm]) ** 2
        P = self._P + np.diag(Q)
        P[:n, :n] += self._rate_moment() * (step * self.settings.lag) ** 2
        self._set(P, state)

    def _set(self, P: Array, state: Array) -> None:
        self._P = 0.5 * (P + P.T)
        self._Y = np.linalg.inv(self._P)
        self._y = self._Y @ state

    def _take_in(self, adjustment: Adjustment) -> Innovation:
        n = len(self._free)
        z = (adjustment.values - self._held)[self._free] / self._scale[:n]
        R = self._scaled(adjustment.covariance)
        R = R + self._rate_moment() * self.settings.thermometer_sd**2
        H = self._H()
        v = z - H @ self._state()
        S = H @ self._P @ H.T + R
        chi2 = float(v @ np.linalg.solve(S, v))
        bound = chi2_quantile(1.0 - self.settings.alpha, n)
        change: Change = ""
        if chi2 > bound:
            self._surprised += 1
            if self._surprised < 2:
                return Innovation(chi2, bound, n, "outlier")
            change = self._name(adjustment, v, S)
            self._open(change)
        self._surprised = 0
        N = np.linalg.inv(R)
        self._Y = self._Y + H.T @ N @ H
        self._y = self._y + H.T @ (N @ z)
        P = np.linalg.inv(self._Y)
        self._P = 0.5 * (P + P.T)
        self.epochs += 1
        return Innovation(chi2, bound, n, change)

    def _name(self, adjustment: Adjustment, v: Array, S: Array) -> Change:
        """Which parameters, let go alone, explain the innovation."""
        c = PARAMETER_NAMES.index("c")
        was = self.values()[c]
        if abs(adjustment.values[c] - was) > _OTHER_LENS * was:
            return "wrong_lens"
        weight = np.linalg.inv(S)
        left: dict[Change, float] = {}
        for name, block in (("slip", _WARM), ("knock", _EOP)):
            columns = [k for k, i in enumerate(self._free) if i in block]
            if not columns:
                continue
            A = np.eye(len(v))[:, columns]
            x = np.linalg.solve(A.T @ weight @ A, A.T @ weight @ v)
            rest = v - A @ x
            degrees = max(1, len(v) - len(columns))
            left[name] = float(rest @ weight @ rest) / chi2_quantile(  # type: ignore[index]
                1.0 - self.settings.alpha, degrees
            )
        best = min(left, key=lambda name: left[name])
        # x0, y0 and the tilt are nearly the same thing: what explains, not what explains alone
        return best if left[best] < 1.0 or left[best] < 0.1 * max(left.values()) else "change"

    def _open(self, change: Change) -> None:
        """Forget what a change has made untrue."""
        block = {"slip": _WARM, "knock": _EOP}.get(change, tuple(range(16)))
        P = self._P.copy()
        state = self._state()
        for k, i in enumerate(self._free):
            if i in block:
                P[k, k] += _FAR**2
        self._set(P, state)
