"""The thermal model of a camera: its interior orientation as a function of temperature history.

The base model is linear: the interior orientation at the reference temperature T₀ plus rates times
(T - T₀), with T at the frame's time. Effects of the catalogue are added; those of kind `drive`
replace the T of the linear terms, one after the other in the order of the list.

With the principal distance, the distortion changes too. A lens that moves along its axis keeps the
angles of its rays. With r = c tan θ, the displacement x̄ A_i r^(2i) is c times a function of the
angle alone if A_i c^(2i) and B c are constant, so that

    A_i(t) = A_i (c₀ / c(t))^(2i),    B_i(t) = B_i c₀ / c(t),

like OpenCV's k_i and p_i; C1 and C2 are such functions already. In the other basis, A and B stay
functions of the place in the image, in mm. Linear values refer to c₀; with the basis `angle` they
are converted to c.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera.camera_model import (
    EOP_NAMES,
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.physics import catalogue
from thermocald.physics.catalogue import drive
from thermocald.physics.effect import Prediction

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import TestField
    from thermocald.physics.history import History


Distortion = Literal["angle", "image"]
BASES: tuple[Distortion, ...] = ("angle", "image")

SURE = 3.0  # standard deviations: a true `angle` is rejected in 0.1 % of all series

_POWERS = np.array([0, 0, 0, 2, 4, 6, 1, 1, 0, 0])  # of c, in the order of IOP_NAMES


def follow_angle(linear: Array, c0: float) -> Array:
    """Return interior orientations (…, 10) whose distortion, valid at c0 mm, follows the angle."""
    return np.asarray(linear * (c0 / linear[..., :1]) ** _POWERS)


def distortion_along(iop: Array) -> Array:
    """Return ∂ interior orientation / ∂ linear one (10, 10) at its c₀, where c changes A and B."""
    out = np.eye(10)
    out[:, 0] -= _POWERS * iop / iop[0]
    return out


def choose_basis(left: Mapping[Distortion, float]) -> tuple[Distortion, float]:
    """Choose the distortion's basis by the sum of squares left with each; return it and its sigmas.

    The choice is the angle unless the data reject it by 3 standard deviations: if they do not
    decide, the angle is what known cameras keep.
    """
    better = left["image"] - left["angle"]
    sigmas = float(np.sign(better) * np.sqrt(abs(better)))
    return ("image", -sigmas) if sigmas < -SURE else ("angle", sigmas)


_LEFT_OVER = 1.5  # times the noise: up to this misfit, an untested model's sds are stated

RATED = ("c", "x0", "y0")
"""The parameters that are linear in the temperature in every model."""


@dataclass(frozen=True)
class ModelEffect:
    """An effect in a model.

    values: {parameter: a number, the name of a channel, or names of targets}; sds: standard
    deviations, where known.
    """

    name: str
    values: Mapping[str, Any]
    sds: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        catalogue.get(self.name).check(self.values)


@dataclass(frozen=True)
class ThermalModel:
    """A camera's thermal model; immutable; `model_file` reads and writes it as YAML.

    camera: its name; interior: at T0 °C; rates: {parameter of RATED: mm/K}; sds: standard
    deviations of `interior.c`, `rates.c`, … (effects hold their own); covariance_names, covariance:
    the full matrix of a fitted model (`interior.c`, `thermal_lag.tau`, …), else () and None;
    distortion: whether it follows the `angle` or the place in the `image` while c changes;
    image_sigma: px, of an image coordinate; exterior: of the set-up, or None; validity: {channel:
    (low, high)} °C of the data; fitted_on: the data, as free mappings; evidence: free text and
    numbers, e.g. of a discovery.
    """

    camera: str
    sensor: Sensor
    T0: float
    interior: InteriorOrientation
    rates: Mapping[str, float] = field(default_factory=dict)
    effects: tuple[ModelEffect, ...] = ()
    exterior: ExteriorOrientation | None = None
    distortion: Distortion = "angle"
    image_sigma: float = 0.04
    sds: Mapping[str, float] = field(default_factory=dict)
    covariance_names: tuple[str, ...] = ()
    covariance: tuple[tuple[float, ...], ...] | None = None
    validity: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    fitted_on: Sequence[Mapping[str, Any]] = ()
    evidence: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    version: int = 1

    def __post_init__(self) -> None:
        for name in self.rates:
            if name not in RATED:
                raise ConfigurationError(
                    f"the base model has no rate of {name!r}, only of {', '.join(RATED)}; "
                    "other parameters drift by effects"
                )
        if not self.interior.c > 0:
            raise ConfigurationError(f"the principal distance is {self.interior.c} mm, not above 0")

    @cached_property
    def rate_vector(self) -> Array:
        """The rates (10,) per K in the order of IOP_NAMES."""
        return np.array([self.rates.get(name, 0.0) for name in IOP_NAMES])

    @property
    def drives(self) -> list[tuple[str, Mapping[str, Any]]]:
        """The effects that replace T, in order, with their values."""
        return [(e.name, e.values) for e in self.effects if catalogue.get(e.name).is_drive]

    def drive(self, history: History) -> Array:
        """Return the temperature (E,) °C in the linear terms: T passed through all drives."""
        return drive(history, self.drives)

    def predict(self, history: History, test_field: TestField | None = None) -> Prediction:
        """Return the model's prediction for the history's times.

        Raises DataError if a temperature column is missing, ConfigurationError if the test field
        lacks a target that an effect names.
        """
        history = replace(history, T0=self.T0)
        prediction = Prediction.none(len(history.times), test_field)
        for effect in self.effects:
            catalogue.get(effect.name).influence(history, effect.values, prediction)
        prediction.drive = self.drive(history)
        linear = self.interior.as_array() + (prediction.drive - self.T0)[:, None] * self.rate_vector
        prediction.iop = self.carried(linear + prediction.iop)
        if self.exterior:
            prediction.eop += self.exterior.as_array()
        return prediction

    def influence(self, name: str, history: History) -> Array:
        """Return what one of the effects adds to the interior orientation, (E, 10)."""
        effect = next(e for e in self.effects if e.name == name)
        prediction = Prediction.none(len(history.times))
        catalogue.get(name).influence(history, effect.values, prediction)
        return prediction.iop

    def followers(self) -> list[Any]:
        """Return one follower per drive, in order; None for a drive that needs all readings.

        Called one after the other, they give the temperature that the rates follow.
        """
        return [catalogue.get(name).follower(values) for name, values in self.drives]

    @property
    def is_of_now(self) -> bool:
        """Whether the first, the extreme and the last readings determine the effects.

        They do not if a drive that looks ahead comes before another: it changes its past values.
        """
        if any(float(v.get(catalogue.get(n).delay, 0.0)) < 0 for n, v in self.drives[:-1]):
            return False
        kinds = [catalogue.get(e.name) for e in self.effects]
        return all(k.is_drive or k.of_now or not set(k.linear) & set(IOP_NAMES) for k in kinds)

    def carried(self, linear: Array) -> Array:
        """Return the interior orientations (…, 10) for linear ones, in the distortion's basis."""
        return follow_angle(linear, self.interior.c) if self.distortion == "angle" else linear

    def carried_derivatives(self, linear: Array, J: Array, names: Sequence[str] = ()) -> Array:
        """Return ∂ interior orientation / ∂ unknowns (…, 10, p), given J = ∂ linear / ∂ unknowns.

        names: of the unknowns, if `interior.c` may be among them.
        """
        if self.distortion == "image":
            return J
        c0 = self.interior.c
        factors = follow_angle(linear, c0) * _POWERS
        out: Array = J * ((c0 / linear[..., :1]) ** _POWERS)[..., None]
        out = out - (factors / linear[..., :1])[..., None] * J[..., :1, :]
        if "interior.c" in names:
            out[..., list(names).index("interior.c")] += factors / c0
        return out

    def with_effect(self, effect: ModelEffect) -> ThermalModel:
        """Return the next version of the model, with a further effect."""
        return replace(self, effects=(*self.effects, effect), version=self.version + 1)

    @property
    def misses_an_effect(self) -> bool:
        """Whether the fit found that an effect is missing; the standard deviations are then void.

        A fit that could not be tested counts if it left more than noise.
        """
        fit = self.evidence.get("fit") or {}
        if fit.get("effect_missing", False) is None:
            return bool(fit.get("left_over_in_noise", 1.0) > _LEFT_OVER)
        return bool(fit.get("effect_missing", False))

    def parameter_names(self) -> tuple[str, ...]:
        """Return the names of all numbers, as in `sds` and `covariance_names`."""
        numbers = [f"interior.{n}" for n in IOP_NAMES] + [f"rates.{n}" for n in RATED]
        if self.exterior is not None:
            numbers += [f"exterior.{n}" for n in EOP_NAMES]
        for effect in self.effects:
            numbers += [
                f"{effect.name}.{n}"
                for n, value in effect.values.items()
                if isinstance(value, int | float)
            ]
        return tuple(numbers)

    def value(self, name: str) -> float:
        """Return a number by its name in `parameter_names`; not of the exterior orientation."""
        group, key = name.rsplit(".", 1)  # a formula may hold dots
        if group == "interior":
            return float(getattr(self.interior, key))
        if group == "rates":
            return float(self.rates.get(key, 0.0))
        return float(next(e for e in self.effects if e.name == group).values[key])

    def sd(self, name: str) -> float:
        """Return the standard deviation of a number by its name, 0 if unknown."""
        group, key = name.rsplit(".", 1)
        if group in ("interior", "rates"):
            return float(self.sds.get(name, 0.0))
        return float(next(e for e in self.effects if e.name == group).sds.get(key, 0.0))

    def with_values(self, numbers: Mapping[str, float]) -> ThermalModel:
        """Return the model with other values for some numbers, as in `parameter_names`."""
        own: dict[str, dict[str, float]] = {}
        for name, value in numbers.items():
            group, key = name.rsplit(".", 1)
            own.setdefault(group, {})[key] = value
        effects = tuple(
            replace(e, values={**e.values, **own[e.name]}) if e.name in own else e
            for e in self.effects
        )
        return replace(
            self,
            interior=replace(self.interior, **own.get("interior", {})),
            rates={**self.rates, **own.get("rates", {})},
            effects=effects,
        )

    def covariance_of(self, names: Sequence[str]) -> Array:
        """Return the covariance (k, k) of some numbers; those outside the matrix have their sds."""
        place = {name: i for i, name in enumerate(self.covariance_names) if self.covariance}
        out = np.diag([0.0 if name in place else self.sd(name) ** 2 for name in names])
        known = [i for i, name in enumerate(names) if name in place]
        if known:
            rows = [place[names[i]] for i in known]
            out[np.ix_(known, known)] = np.array(self.covariance)[np.ix_(rows, rows)]
        return out
