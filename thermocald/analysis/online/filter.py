"""The recursive estimate of one camera: a Schmidt-Kalman filter over IOP, EOP and a thermal model.

The state is the orientation at T₀ and the rates of c, x0, y0 per kelvin; every epoch's adjustment
adds its information, so that after an hour a static camera's exterior orientation is known far
better than from any single epoch. What an epoch says beyond what was expected is its innovation;
its chi-square shows a knock, a slip of the principal point, another lens.

The errors of the test field are the same in all epochs. They are considered, not estimated: their
covariance with the state is carried along, so that they cancel in the innovations and stay in the
standard deviations of the estimate. The thermometer's noise counts as noise of the epoch, and while
the temperature changes the prediction is trusted less: the camera may lag.

Sources: Schmidt (1966), Application of state-space methods to navigation problems, Advances in
Control Systems 3 (consider states); innovation test: Bar-Shalom, Li and Kirubarajan (2001),
Estimation with Applications to Tracking and Navigation, section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from thermocald.analysis.online.field_errors import EpochErrors
from thermocald.photogrammetry.camera.camera_model import EOP, PARAMETER_NAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment

__all__ = ["FilterSettings", "Innovation", "OnlineFilter", "chi2_quantile"]

Change = Literal["", "outlier", "knock", "slip", "wrong_lens", "change"]

_WARM = (0, 1, 2)  # c, x0, y0 follow the temperature
_EOP = tuple(range(10, 16))
_OTHER_LENS = 0.02  # of c
_FAR = 1e4  # prior sd of what is not known, in sd of the first epoch
_TRUSTED, _DOUBTFUL = 4.0, 2.0  # a rise of temperature from here on, in sd of a reading
_FEW_READINGS = 5


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """How the filter expects a camera to behave.

    thermometer_sd K; wander_px: of c, x0, y0 per √epoch beyond the thermal model; lag: fraction of
    a change of temperature that may reach the camera later; alpha: error probability of one test;
    rate_sd_px: prior sd of the rates per kelvin; unknown_step K: what the temperature may change by
    from epoch to epoch where there is no thermometer.
    """

    thermometer_sd: float = 0.05
    wander_px: float = 0.003
    lag: float = 0.5
    alpha: float = 1e-6
    rate_sd_px: float = 5.0
    unknown_step: float = 0.3


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

    common_variances (m,): of errors that all epochs have in common, in the units of the influence
    that `update` is given; None: there are none. Attributes: epochs taken in; T0,
    last_temperature °C. All in the units of CONVENTIONS §2.
    """

    def __init__(
        self,
        sensor: Sensor,
        settings: FilterSettings | None = None,
        common_variances: Array | None = None,
    ) -> None:
        self.sensor = sensor
        self.settings = settings or FilterSettings()
        self.epochs = 0
        self.T0 = self.last_temperature = float("nan")
        self._common = np.empty(0) if common_variances is None else common_variances
        self._free: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self._surprised = 0
        self._rise = self._rise_variance = 0.0
        self._readings, self._warmed = 0, False

    def update(
        self, adjustment: Adjustment, temperature: float, errors: EpochErrors | None = None,
        tremble: Array | None = None,
    ) -> Innovation | None:  # fmt: skip
        """Take an epoch in; None if it has no result.

        temperature: °C at the frame, NaN where it is not known: the last one then still holds;
        errors: the epoch's covariance split into noise and common errors, by default all is noise;
        tremble (6, 6): covariance of the mount's movements about its mean, of the epochs so far.
        """
        if not adjustment.ok:
            return None
        if errors is None:
            errors = EpochErrors(adjustment.covariance, np.zeros((16, len(self._common))))
        variance = np.diag(adjustment.covariance)
        free = np.flatnonzero(variance > 0)
        if not self.epochs or not np.array_equal(free, self._free):
            self._start(adjustment, errors, free, temperature, tremble)
            return Innovation(0.0, 0.0, len(free), "")
        before = self._rise
        if not np.isnan(temperature):
            self._read(temperature)
        unknown = self.settings.unknown_step if np.isnan(self.T0) else 0.0
        self._predict(np.hypot(self._rise - before, unknown))
        innovation = self._take_in(adjustment, errors)
        if not self._surprised and tremble is not None:
            # a knock is not judged by a movement that it is part of
            self._tremble = tremble
        return innovation

    @property
    def rates(self) -> Array:
        """Rates of c, x0, y0 mm/K."""
        result: Array = (self._x * self._scale)[len(self._free) :]
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
        out[self._free] += self._H() @ self._x * self._scale[: len(self._free)]
        return out

    def covariance(self) -> Array:
        """(16, 16) of `values`, errors of the test field included; zero where held."""
        H = self._H()
        s = self._scale[: len(self._free)]
        out = np.zeros((16, 16))
        out[np.ix_(self._free, self._free)] = H @ self._P @ H.T * np.outer(s, s)
        return out

    def _read(self, temperature: float) -> None:
        """The rise of temperature above T₀, 0 where the readings' noise explains it.

        A camera at one temperature stays as it is whatever its rates: were the noise of the
        readings taken for changes, unknown rates would hide every knock, and seem to be zero.
        """
        if np.isnan(self.T0):
            self.T0, self._readings = temperature, 1
        self.last_temperature = temperature
        rise = temperature - self.T0
        sd = self.settings.thermometer_sd * np.sqrt(1.0 + 1.0 / self._readings)
        trusted = 1.0 - (_TRUSTED * sd / rise) ** 2 if abs(rise) > _TRUSTED * sd else 0.0
        doubtful = (1.0 - trusted) * rise if abs(rise) > _DOUBTFUL * sd else 0.0
        if self._readings < _FEW_READINGS:
            doubtful = float(np.hypot(doubtful, sd))
        self._rise = trusted * rise
        self._rise_variance = (trusted * self.settings.thermometer_sd) ** 2 + doubtful**2
        self._warmed = self._warmed or trusted > 0.0
        if not self._warmed:
            self._readings += 1
            self.T0 += (temperature - self.T0) / self._readings

    def _start(
        self,
        adjustment: Adjustment,
        errors: EpochErrors,
        free: NDArray[np.int64],
        temperature: float,
        tremble: Array | None,
    ) -> None:
        self._free = free
        self._tremble = np.zeros((6, 6)) if tremble is None else tremble
        self._held = adjustment.values.copy()
        sd = np.sqrt(np.diag(adjustment.covariance))[free]
        rate_scale = np.full(3, self.sensor.pixel_pitch)
        self._scale = np.concatenate([sd, rate_scale])
        self._warm = np.array([k for k, i in enumerate(free) if i in _WARM], dtype=np.int64)
        self._rate_of = np.array([int(free[k]) for k in self._warm], dtype=np.int64)
        n = len(free)
        R, K = self._scaled(errors)
        self._P = np.zeros((n + 3, n + 3))
        self._P[:n, :n] = R + K * self._common @ K.T
        self._P[n:, n:] = np.eye(3) * self.settings.rate_sd_px**2
        # Truth minus estimate against the common errors: what they did to the first epoch.
        self._C = np.zeros((n + 3, len(self._common)))
        self._C[:n] = -K * self._common
        self._x = np.zeros(n + 3)
        self.T0 = self.last_temperature = temperature
        self._readings = 1
        self._rise = 0.0
        self._rise_variance = 0.0
        self._warmed = False
        self.epochs = 1
        self._surprised = 0

    def _scaled(self, errors: EpochErrors) -> tuple[Array, Array]:
        """Noise (n, n) and influence (n, m) of the scaled free parameters."""
        s = self._scale[: len(self._free)]
        moves = np.zeros((16, 16))
        moves[EOP, EOP] = self._tremble
        noise: Array = (errors.noise + moves)[np.ix_(self._free, self._free)] / np.outer(s, s)
        influence: Array = errors.influence[self._free] / s[:, None]
        return noise, influence

    def _H(self) -> Array:
        """Scaled state → scaled free parameters, at the last temperature."""
        n = len(self._free)
        H = np.hstack([np.eye(n), np.zeros((n, 3))])
        for k, i in zip(self._warm, self._rate_of, strict=True):
            H[k, n + i] = self._rise * self._scale[n + i] / self._scale[k]
        return H

    def _rate_moment(self) -> Array:
        """E[r rᵀ] of the rates r as a column of scaled free parameters per kelvin, (n, n).

        With the rates' own covariance in it: while they are unknown, a noisy thermometer must not
        seem to determine them.
        """
        n = len(self._free)
        moment = np.outer(self._x[n:], self._x[n:]) + self._P[n:, n:]
        to = np.zeros((n, 3))
        for k, i in zip(self._warm, self._rate_of, strict=True):
            to[k, i] = self._scale[n + i] / self._scale[k]
        result: Array = to @ moment @ to.T
        return result

    def _predict(self, step: float) -> None:
        n = len(self._free)
        wander = self.settings.wander_px * self.sensor.pixel_pitch
        self._P[self._warm, self._warm] += (wander / self._scale[self._warm]) ** 2
        self._P[:n, :n] += self._rate_moment() * (step * self.settings.lag) ** 2

    def _take_in(self, adjustment: Adjustment, errors: EpochErrors) -> Innovation:
        n = len(self._free)
        z = (adjustment.values - self._held)[self._free] / self._scale[:n]
        R, K = self._scaled(errors)
        R += self._rate_moment() * self._rise_variance
        H = self._H()
        v = z - H @ self._x
        common = K * self._common
        S, cross = self._innovation(H, K, common, R)
        chi2 = float(v @ np.linalg.solve(S, v))
        bound = chi2_quantile(1.0 - self.settings.alpha, n)
        change: Change = ""
        if chi2 > bound:
            self._surprised += 1
            if self._surprised < 2:
                return Innovation(chi2, bound, n, "outlier")
            change = self._name(adjustment, v, S)
            self._open(change)
            S, cross = self._innovation(H, K, common, R)
        self._surprised = 0
        gain: Array = np.asarray(np.linalg.solve(S, cross.T).T, dtype=np.float64)
        self._x = self._x + gain @ v
        self._update_covariance(H, K, common, R, gain)
        self.epochs += 1
        return Innovation(chi2, bound, n, change)

    def _innovation(self, H: Array, K: Array, common: Array, R: Array) -> tuple[Array, Array]:
        """Covariance (n, n) of the innovation, and of the state with it (n + 3, n)."""
        cross = self._P @ H.T + self._C @ K.T
        S: Array = H @ cross + K @ self._C.T @ H.T + common @ K.T + R
        return 0.5 * (S + S.T), cross

    def _update_covariance(self, H: Array, K: Array, common: Array, R: Array, gain: Array) -> None:
        """Joseph's form, which stays positive where a change has opened the state."""
        left = np.eye(len(self._x)) - gain @ H
        mixed = left @ self._C @ (gain @ K).T
        P = left @ self._P @ left.T - mixed - mixed.T + gain @ (common @ K.T + R) @ gain.T
        self._P = 0.5 * (P + P.T)
        self._C = left @ self._C - gain @ common

    def _name(self, adjustment: Adjustment, v: Array, S: Array) -> Change:
        """Which parameters, freed alone, explain the innovation."""
        c = PARAMETER_NAMES.index("c")
        was = self.values()[c]
        if abs(adjustment.values[c] - was) > _OTHER_LENS * was:
            return "wrong_lens"
        weight = np.linalg.inv(S)
        left: dict[Change, float] = {}
        blocks: tuple[tuple[Change, tuple[int, ...]], ...] = (("slip", _WARM), ("knock", _EOP))
        for name, block in blocks:
            columns = [k for k, i in enumerate(self._free) if i in block]
            if not columns:
                continue
            A = np.eye(len(v))[:, columns]
            x = np.linalg.solve(A.T @ weight @ A, A.T @ weight @ v)
            rest = v - A @ x
            degrees = max(1, len(v) - len(columns))
            bound = chi2_quantile(1.0 - self.settings.alpha, degrees)
            left[name] = float(rest @ weight @ rest) / bound
        best = min(left, key=lambda name: left[name])
        # x0, y0 and the tilt are nearly the same thing: what explains, not what explains alone
        return best if left[best] < 1.0 or left[best] < 0.1 * max(left.values()) else "change"

    def _open(self, change: Change) -> None:
        """Forget what a change has made untrue."""
        block = {"slip": _WARM, "knock": _EOP}.get(change, tuple(range(16)))
        rows = [k for k, i in enumerate(self._free) if i in block]
        self._P[rows, rows] += _FAR**2
