"""The recursive estimate of one camera: a Schmidt-Kalman filter over IOP, EOP and a thermal model.

The state is the orientation at T₀ and the rates of c, x0, y0 per kelvin; every epoch's adjustment
adds its information, so that after an hour a static camera's exterior orientation is far more
precise than from any single epoch. The difference of an epoch from its prediction is its
innovation; its chi-square shows a knock, a slip of the principal point, another lens.

The errors of the test field are the same in all epochs. They are considered, not estimated: their
covariance with the state is propagated, so that they cancel in the innovations and remain in the
standard deviations of the estimate. With the design matrices A (parameters) and B (coordinates),
the weights W and Q = (AᵀWA)⁻¹, the error of an epoch is G e + K d, where G = QAᵀW, K = GB, e is the
noise and d the errors of the coordinates. The level of the noise is measured from the differences
between the residuals of consecutive epochs, in which the errors of the field cancel; sigma0 also
depends on how well the field's standard deviations are stated.

The thermometer's noise counts as noise of the epoch. While the temperature changes, the prediction
has a larger variance: the camera may lag.

Sources: Schmidt (1966), Application of state-space methods to navigation problems, Advances in
Control Systems 3 (consider states); innovation test: Bar-Shalom, Li and Kirubarajan (2001),
Estimation with Applications to Tracking and Navigation, section 5.4.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP, PARAMETER_NAMES, project
from thermocald.photogrammetry.epoch.gauss_markov import point_covariances
from thermocald.photogrammetry.linalg import chi2_quantile, scaled_inverse
from thermocald.photogrammetry.series.normals import Partials, as_matrices, linearise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.epoch.adjustment import Adjustment
    from thermocald.photogrammetry.field.testfield import Observations, TestField


_MEMORY = 50  # epochs over which the level of the noise is averaged
_LEAST_DEGREES = 10.0
_MOVED_PX = 30.0  # a movement beyond it needs new partials
_OTHER_LENS = 0.02  # relative change of c that means another lens, and needs new partials
_LOWEST, _HIGHEST = 0.05, 20.0  # bounds of measured over stated variance of an image point


class FieldErrors:
    """The errors of consecutive epochs, split into noise and errors of the test field.

    variances (3 T,): of the targets' coordinates, mm²; level: measured over stated variance of the
    image points, that is the first epoch's σ₀² until there are two epochs.
    """

    def __init__(self, sensor: Sensor, testfield: TestField) -> None:
        self.variances: Array = np.square(testfield.shape_sigmas).ravel()
        self.level = 1.0
        self._sensor = sensor
        self._field = testfield
        self._before: tuple[Array, Array] | None = None
        self._at: Partials | None = None
        self._compared = 0

    def split(
        self, adjustment: Adjustment, observations: Observations, field_variance: float = 1.0
    ) -> tuple[Array, Array]:
        """Split the errors of the 16 parameters of an epoch with a result.

        adjustment: of these observations; parameters with a variance are free; field_variance:
        factor of the stated covariance of the coordinates. Returns noise (16, 16): covariance from
        the image points alone, zero for held parameters, and influence (16, 3 T): of the
        coordinates of all T targets, per mm, zero for targets that the epoch did not use.
        """
        free = np.flatnonzero(np.diag(adjustment.covariance) > 0)
        used = observations.select(~np.isin(observations.targets, adjustment.rejected))
        rows = used.targets
        at = self._linearised(adjustment.values)
        A, B = at.A[rows], np.sqrt(field_variance) * at.B[rows]
        image = as_matrices(point_covariances(used, None, None))
        total = as_matrices(point_covariances(used, B, self._field.shape_sigmas[rows] ** 2))
        A = A[:, :, free]
        WA = np.linalg.solve(total, A)
        G = np.einsum("uv,niv->nui", scaled_inverse(np.einsum("niu,niv->uv", A, WA)), WA)
        noise = np.einsum("nui,nij,nvj->uv", G, image, G)
        information = np.einsum("niu,niv->uv", A, np.linalg.solve(image, A))
        influence = np.zeros((16, len(self._field), 3))
        influence[np.ix_(free, rows)] = np.einsum("nui,nik->unk", G, B)
        self._measure_level(adjustment, used, influence.reshape(16, -1)[free], noise, information)
        if not self._compared:
            # a single epoch: its own residuals, which contain the field's errors, too
            redundancy = 2 * len(used) - len(free)
            own = min(max(adjustment.sigma0**2, _LOWEST), _HIGHEST)
            self.level = own if redundancy >= _LEAST_DEGREES else max(own, 1.0)
        covariance = np.zeros((16, 16))
        covariance[np.ix_(free, free)] = self.level * noise
        return covariance, influence.reshape(16, -1)

    def _linearised(self, values: Array) -> Partials:
        """Return partials of all targets, at one orientation as long as the camera stays near it.

        Partials at every epoch's own values would differ by its noise, and a filter would use these
        differences as information on the field.
        """
        if (at := self._at) is not None:
            now = project(self._sensor, values[:10], values[10:], self._field.points)
            moved = float(np.nanmedian(np.abs(now - at.predicted)))
            if moved < _MOVED_PX and abs(values[0] / at.iop[0] - 1.0) <= _OTHER_LENS:
                return at
        self._at = linearise(self._sensor, self._field, values[:10], values[10:])
        return self._at

    def _measure_level(
        self,
        adjustment: Adjustment,
        used: Observations,
        influence: Array,
        noise: Array,
        information: Array,
    ) -> None:
        """Update the level of the noise from the residuals of this epoch and the one before.

        influence (u, 3 T), noise (u, u): of the free parameters; information (u, u): of the image
        points alone.
        """
        residuals = np.full((len(self._field), 2), np.nan)
        residuals[adjustment.targets] = adjustment.residuals
        whitened = np.full_like(residuals, np.nan)
        whitened[used.targets] = residuals[used.targets] / used.sigmas
        before, self._before = self._before, (whitened, influence)
        if before is None or len(before[1]) != len(influence):
            return
        both = np.isfinite(before[0][:, 0]) & np.isfinite(whitened[:, 0])
        u = float(len(influence))
        # the weights include the field: only without it the trace is the number of unknowns
        overlap = min(float(np.sum(noise * information)), u)
        degrees = 2.0 * np.count_nonzero(both) - 2.0 * u + overlap
        if degrees < _LEAST_DEGREES:
            return
        found = float(np.sum((whitened[both] - before[0][both]) ** 2))
        # with other targets in view, the field's errors shift the parameters differently
        shift = influence - before[1]
        found -= float(np.sum((shift * self.variances @ shift.T) * information))
        found = min(max(found / (2.0 * degrees), _LOWEST), _HIGHEST)
        self._compared = min(self._compared + 1, _MEMORY)
        self.level += (found - self.level) / self._compared


Change = Literal["", "outlier", "knock", "slip", "wrong_lens", "change"]

_WARM = (0, 1, 2)  # c, x0, y0 follow the temperature
_BLOCKS: dict[Change, tuple[int, ...]] = {"slip": _WARM, "knock": tuple(range(10, 16))}
_FAR = 1e4  # prior sd of an unknown parameter, in sds of the first epoch
_TRUSTED, _DOUBTFUL = 4.0, 2.0  # a larger rise of temperature, in sds of a reading, is so
_FEW_READINGS = 5
_THERMOMETER_SD = 0.05  # K
_WANDER_PX = 0.003  # of c, x0, y0 per √epoch beyond the thermal model
_LAG = 0.5  # fraction of a change of temperature that may reach the camera later
_ALPHA = 1e-6  # error probability of one test
_HISTORY, _FEWEST = 100, 10  # epochs that show how much a camera usually moves
_USUAL, _BEYOND = 0.9, 3.0  # quantile of their chi-squares, and the multiple of it for an event
_RATE_SD_PX = 5.0  # prior sd of the rates per kelvin
# K/s and K from epoch to epoch without a reading of its own, unless it changed faster before
_UNKNOWN_RATE, _UNKNOWN_STEP = 0.03, 0.3


@dataclass(frozen=True, slots=True)
class Innovation:
    """The innovation test of an epoch: chi-square, its bound, degrees of freedom, and the change.

    change: "" if the epoch is as predicted; "outlier" for a first contradiction, which the filter
    does not use; one that persists is a knock (EOP), a slip (x0, y0, c), another lens, or some
    other change.
    """

    chi2: float
    bound: float
    dof: int
    change: Change


class OnlineFilter:
    """The recursive estimate, updated epoch by epoch.

    common_variances (m,): of errors that all epochs share, in the units of the influence that
    `update` is given. Attributes: epochs, the number used; T0, last_temperature °C. All in the
    units of CONVENTIONS §2.
    """

    def __init__(self, sensor: Sensor, common_variances: Array) -> None:
        self.sensor = sensor
        self.epochs = 0
        self.T0 = self.last_temperature = float("nan")
        self._common = common_variances
        self._free: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self._history: deque[float] = deque(maxlen=_HISTORY)

    def _start(
        self, adjustment: Adjustment, errors: tuple[Array, Array], free: NDArray[np.int64],
        temperature: float, tremble: Array | None,
    ) -> None:  # fmt: skip
        self._free = free
        self._tremble = np.zeros((6, 6)) if tremble is None else tremble
        self._held = adjustment.values.copy()
        n, sd = len(free), np.sqrt(np.diag(adjustment.covariance))[free]
        self._scale = np.concatenate([sd, np.full(3, self.sensor.pixel_pitch)])
        self._warm = np.flatnonzero(np.isin(free, _WARM))
        # change of the scaled free parameters (n,) by the scaled rates (3,), per kelvin
        self._by_rate = np.zeros((n, 3))
        for k in self._warm:
            self._by_rate[k, free[k]] = self._scale[n + free[k]] / self._scale[k]
        R, K = self._scaled(errors)
        self._P = np.zeros((n + 3, n + 3))
        self._P[:n, :n] = R + K * self._common @ K.T
        self._P[n:, n:] = np.eye(3) * _RATE_SD_PX**2
        # covariance of truth minus estimate with the common errors, from the first epoch
        self._C = np.zeros((n + 3, len(self._common)))
        self._C[:n] = -K * self._common
        self._x = np.zeros(n + 3)
        self.T0 = self.last_temperature = temperature
        self._readings, self._warmed = 1, False
        self._rise = self._rise_variance = 0.0
        self._rate = self._unread_s = 0.0  # K/s between the last two readings; since the last, s
        self.epochs, self._surprised = 1, 0

    def update(
        self, adjustment: Adjustment, temperature: float, errors: tuple[Array, Array],
        tremble: Array | None = None, elapsed_s: float = 10.0,
    ) -> Innovation:  # fmt: skip
        """Update the estimate with an epoch that has a result.

        temperature: °C at the frame, NaN if it has no reading of its own: the camera then is where
        it was, as uncertain as its temperature may have changed; errors: noise (16, 16) and
        influence of the common errors, from `FieldErrors.split`; tremble (6, 6): covariance of the
        mount's movements about its mean, from the epochs so far; elapsed_s: since the last epoch.
        """
        free = np.flatnonzero(np.diag(adjustment.covariance) > 0)
        if not self.epochs or not np.array_equal(free, self._free):
            self._start(adjustment, errors, free, temperature, tremble)
            return Innovation(0.0, 0.0, len(free), "")
        before, unknown = self._rise, 0.0
        self._unread_s += elapsed_s
        if np.isnan(temperature):
            unknown = max(self._rate * elapsed_s, min(_UNKNOWN_RATE * elapsed_s, _UNKNOWN_STEP))
        else:
            self._read(temperature)
            self._rate = abs(self._rise - before) / max(self._unread_s, 1e-3)
            self._unread_s = 0.0
        step = np.hypot((self._rise - before) * _LAG, unknown)
        n, warm = len(free), self._warm
        wander = _WANDER_PX * self.sensor.pixel_pitch
        self._P[warm, warm] += (wander / self._scale[warm]) ** 2
        self._P[:n, :n] += self._rate_moment() * step**2
        z = (adjustment.values - self._held)[self._free] / self._scale[:n]
        R, K = self._scaled(errors)
        R += self._rate_moment() * self._rise_variance
        H = self._H()
        v = z - H @ self._x
        common = K * self._common

        def covariances() -> tuple[Array, Array]:
            """Return the covariances of the innovation (n, n), and of the state with it."""
            cross = self._P @ H.T + self._C @ K.T
            S: Array = H @ cross + K @ self._C.T @ H.T + common @ K.T + R
            return 0.5 * (S + S.T), cross

        S, cross = covariances()
        chi2 = float(v @ np.linalg.solve(S, v))
        bound = float(chi2_quantile(1.0 - _ALPHA, n))
        if len(self._history) >= _FEWEST:
            # a mount in the wind does not move normally: movements of a size that a tenth of the
            # epochs show are no event
            bound = max(bound, _BEYOND * float(np.quantile(self._history, _USUAL)))
        self._history.append(chi2)
        change: Change = ""
        if chi2 > bound:
            self._surprised += 1
            if self._surprised < 2:
                return Innovation(chi2, bound, n, "outlier")
            change = self._name(adjustment, v, S)
            # parameters that the change may concern become unknown
            block = _BLOCKS.get(change, tuple(range(16)))
            rows = np.flatnonzero(np.isin(self._free, block))
            self._P[rows, rows] += _FAR**2
            S, cross = covariances()
        self._surprised = 0
        gain: Array = np.asarray(np.linalg.solve(S, cross.T).T, dtype=np.float64)
        self._x = self._x + gain @ v
        # Joseph's form stays positive definite even with the large variances after a change
        left = np.eye(len(self._x)) - gain @ H
        mixed = left @ self._C @ (gain @ K).T
        P = left @ self._P @ left.T - mixed - mixed.T + gain @ (common @ K.T + R) @ gain.T
        self._P = 0.5 * (P + P.T)
        self._C = left @ self._C - gain @ common
        self.epochs += 1
        if tremble is not None:
            # only now: the estimate of the movements already contains a knock in this epoch
            self._tremble = tremble
        return Innovation(chi2, bound, n, change)

    @property
    def rates(self) -> Array:
        """Rates (3,) of c, x0, y0, mm/K."""
        return np.asarray((self._x * self._scale)[len(self._free) :])

    @property
    def rates_covariance(self) -> Array:
        """Covariance (3, 3) of `rates`, mm²/K²."""
        n = len(self._free)
        return self._P[n:, n:] * np.outer(self._scale[n:], self._scale[n:])

    def values(self) -> Array:
        """Return the orientation (16,) at the last temperature, with held parameters."""
        out = self._held.copy()
        out[self._free] += self._H() @ self._x * self._scale[: len(self._free)]
        return out

    def covariance(self) -> Array:
        """Return the covariance (16, 16) of `values`, test field included; zero if held."""
        H = self._H()
        s = self._scale[: len(self._free)]
        out = np.zeros((16, 16))
        out[np.ix_(self._free, self._free)] = H @ self._P @ H.T * np.outer(s, s)
        return out

    def _read(self, temperature: float) -> None:
        """Update the rise of temperature above T₀, which is 0 if the readings' noise explains it.

        A camera at a constant temperature does not change, whatever its rates. If noise of the
        readings counted as changes, unknown rates would hide every knock and be estimated as zero.
        """
        if np.isnan(self.T0):
            self.T0, self._readings = temperature, 1
        self.last_temperature = temperature
        rise = temperature - self.T0
        sd = _THERMOMETER_SD * np.sqrt(1.0 + 1.0 / self._readings)
        trusted = 1.0 - (_TRUSTED * sd / rise) ** 2 if abs(rise) > _TRUSTED * sd else 0.0
        doubtful = (1.0 - trusted) * rise if abs(rise) > _DOUBTFUL * sd else 0.0
        if self._readings < _FEW_READINGS:
            doubtful = float(np.hypot(doubtful, sd))
        self._rise = trusted * rise
        self._rise_variance = (trusted * _THERMOMETER_SD) ** 2 + doubtful**2
        self._warmed = self._warmed or trusted > 0.0
        if not self._warmed:
            self._readings += 1
            self.T0 += (temperature - self.T0) / self._readings

    def _scaled(self, errors: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return noise (n, n) and influence (n, m) of the scaled free parameters."""
        s = self._scale[: len(self._free)]
        noise = errors[0].copy()
        noise[EOP, EOP] += self._tremble
        return noise[np.ix_(self._free, self._free)] / np.outer(s, s), (
            errors[1][self._free] / s[:, None]
        )

    def _H(self) -> Array:
        """Return the matrix from scaled state to scaled free parameters at the last temperature."""
        return np.hstack([np.eye(len(self._free)), self._rise * self._by_rate])

    def _rate_moment(self) -> Array:
        """Return E[r rᵀ] (n, n) of the rates r, in scaled free parameters per kelvin.

        It includes the rates' own covariance: a noisy thermometer must not seem to determine rates
        that are still unknown.
        """
        n = len(self._free)
        moment = np.outer(self._x[n:], self._x[n:]) + self._P[n:, n:]
        return self._by_rate @ moment @ self._by_rate.T

    def _name(self, adjustment: Adjustment, v: Array, S: Array) -> Change:
        """Name the change by the parameters that explain the innovation if only they are free."""
        c = PARAMETER_NAMES.index("c")
        was = self.values()[c]
        if abs(adjustment.values[c] - was) > _OTHER_LENS * was:
            return "wrong_lens"
        weight = np.linalg.inv(S)
        left: dict[Change, float] = {}
        for name, block in _BLOCKS.items():
            A = np.eye(len(v))[:, np.isin(self._free, block)]
            if not A.size:
                continue
            rest = v - A @ np.linalg.solve(A.T @ weight @ A, A.T @ weight @ v)
            bound = chi2_quantile(1.0 - _ALPHA, max(1, len(v) - A.shape[1]))
            left[name] = float(rest @ weight @ rest) / bound
        best = min(left, key=lambda name: left[name])
        # x0, y0 and the tilt are highly correlated: both may explain it, so the better one counts
        return best if left[best] < 1.0 or left[best] < 0.1 * max(left.values()) else "change"
