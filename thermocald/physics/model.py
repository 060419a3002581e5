"""The thermal model of one camera: interior orientation as a function of the temperature history.

The base model is linear: the interior orientation at the reference temperature T₀ plus rates times
(T - T₀), T at the frame's time. Effects of the catalogue are added to it; those of kind `drive`
replace the T of the linear terms, one after the other in the order of the list.

While the principal distance changes, the distortion does too. A lens that moves along its axis
keeps its rays' angles: with r = c tan θ the displacement x̄ A_i r^(2i) is c times a function of the
angle only where A_i c^(2i) and B c are constant, so that

    A_i(t) = A_i (c₀ / c(t))^(2i),    B_i(t) = B_i c₀ / c(t),

as OpenCV's k_i and p_i have it; C1 and C2 are such functions already. The other basis keeps A and B
as functions of the image in mm. Linear values are those at c₀: of `angle` they are carried to c.
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

SURE = 3.0  # standard deviations: an angle that holds is denied in 0.1 % of all series

_POWERS = np.array([0, 0, 0, 2, 4, 6, 1, 1, 0, 0])  # of c, in the order of IOP_NAMES


def follow_angle(linear: Array, c0: float) -> Array:
    """Return interior orientations (…, 10) whose distortion keeps the angles it has at c0 mm."""
    out: Array = linear * (c0 / linear[..., :1]) ** _POWERS
    return out


def angle_derivatives(linear: Array, c0: float, J: Array, by_c0: int | None = None) -> Array:
    """Carry ∂ linear / ∂ unknowns (…, 10, p) to the orientations of `follow_angle`.

    by_c0: the unknown that is c0 itself, if any.
    """
    carried = follow_angle(linear, c0)
    factors = carried * _POWERS
    out: Array = J * ((c0 / linear[..., :1]) ** _POWERS)[..., None]
    out = out - (factors / linear[..., :1])[..., None] * J[..., :1, :]
    if by_c0 is not None:
        out[..., by_c0] += factors / c0
    return out


def distortion_along(iop: Array) -> Array:
    """Return ∂ interior orientation / ∂ linear one (10, 10) at its c₀: c takes A and B along."""
    out = np.eye(10)
    out[:, 0] -= _POWERS * iop / iop[0]
    return out


def choose_basis(left: Mapping[Distortion, float]) -> tuple[Distortion, float]:
    """Return what the distortion follows, of the sums of squares that are left with either, and by
    how many standard deviations the data say so.

    The angle, unless the data deny it by 3 of them: where they cannot tell, the cameras that are
    known keep their angles.
    """
    better = left["image"] - left["angle"]
    sigmas = float(np.sign(better) * np.sqrt(abs(better)))
    return ("image", -sigmas) if sigmas < -SURE else ("angle", sigmas)


_LEFT_OVER = 1.5  # times the noise: what an untested model may leave and state a band

RATED = ("c", "x0", "y0")
"""The parameters that are linear in temperature in every model."""


@dataclass(frozen=True)
class ModelEffect:
    """An effect in a model: its name, parameter values, and their standard deviations.

    values: {parameter: number, or text for a channel, or names of targets}; sds: where known.
    """

    name: str
    values: Mapping[str, Any]
    sds: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        catalogue.get(self.name).check(self.values)


@dataclass(frozen=True)
class ThermalModel:
    """One camera's thermal model; immutable, written to and read from YAML by `model_file`.

    camera: its name; interior: at T0 °C; rates: {parameter of RATED: mm/K}; sds: standard
    deviations of `interior.c`, `rates.c`, … (those of effects stand with them); covariance_names,
    covariance: the full matrix where the model was fitted (`interior.c`, `thermal_lag.tau`, …), or
    () and None;
    distortion: what it follows while c changes, the `angle` or the place in the `image`;
    image_sigma: px, of one coordinate of an image point; exterior: of the set-up, or None;
    validity: {channel: (low, high)} °C that it was fitted on; fitted_on: what it was fitted on,
    free mappings; evidence: free text and numbers, e.g. of a discovery.
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
        """The effects that replace T, in their order, with their values."""
        return [(e.name, e.values) for e in self.effects if catalogue.get(e.name).is_drive]

    def drive(self, history: History) -> Array:
        """Return the temperature (E,) °C behind the linear terms: T through all drives of the
        model.
        """
        return drive(history, self.drives)

    def predict(self, history: History, test_field: TestField | None = None) -> Prediction:
        """Return everything the model says of the history's times.

        Raises DataError where a temperature column is missing, ConfigurationError where the test
        field lacks a target that an effect names.
        """
        history = replace(history, T0=self.T0)
        found = Prediction.none(len(history.times), test_field)
        for effect in self.effects:
            catalogue.get(effect.name).influence(history, effect.values, found)
        found.drive = self.drive(history)
        linear = self.interior.as_array() + (found.drive - self.T0)[:, None] * self.rate_vector
        found.iop = self.carried(linear + found.iop)
        if self.exterior:
            found.eop += self.exterior.as_array()
        return found

    def carried(self, linear: Array) -> Array:
        """Return the interior orientations (…, 10) of those that rates and effects add up to."""
        return follow_angle(linear, self.interior.c) if self.distortion == "angle" else linear

    def carried_derivatives(self, linear: Array, J: Array, names: Sequence[str] = ()) -> Array:
        """Return ∂ interior orientation / ∂ unknowns (…, 10, p) of those of the linear ones.

        names: of the unknowns, where `interior.c` may be among them.
        """
        if self.distortion == "image":
            return J
        place = list(names).index("interior.c") if "interior.c" in names else None
        return angle_derivatives(linear, self.interior.c, J, place)

    def with_effect(self, effect: ModelEffect) -> ThermalModel:
        """Return the next version of the model, with one effect more."""
        return replace(self, effects=(*self.effects, effect), version=self.version + 1)

    def without(self, *names: str) -> ThermalModel:
        """Return the next version of the model, without some of its effects."""
        kept = tuple(e for e in self.effects if e.name not in names)
        return replace(self, effects=kept, version=self.version + 1)

    @property
    def misses_an_effect(self) -> bool:
        """Whether its fit found that an effect is missing, or could not be tested and left more
        than noise; then its numbers hold no band.
        """
        found = self.evidence.get("fit") or {}
        if found.get("effect_missing", False) is None:
            return bool(found.get("left_over_in_noise", 1.0) > _LEFT_OVER)
        return bool(found.get("effect_missing", False))

    def parameter_names(self) -> tuple[str, ...]:
        """List the names of all numbers, as `sds` and `covariance_names` use them."""
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
        """Return one of its numbers, called as in `parameter_names`."""
        group, key = name.split(".", 1)
        if group == "interior":
            return float(getattr(self.interior, key))
        if group == "rates":
            return float(self.rates.get(key, 0.0))
        return float(next(e for e in self.effects if e.name == group).values[key])

    def sd(self, name: str) -> float:
        """Return the standard deviation of one of its numbers, 0 where none is known."""
        group, key = name.split(".", 1)
        if group in ("interior", "rates"):
            return float(self.sds.get(name, 0.0))
        return float(next(e for e in self.effects if e.name == group).sds.get(key, 0.0))

    def with_values(self, numbers: Mapping[str, float]) -> ThermalModel:
        """Return the model with other values of some numbers of rates and effects."""
        own: dict[str, dict[str, float]] = {}
        for name, value in numbers.items():
            group, key = name.split(".", 1)
            own.setdefault(group, {})[key] = value
        effects = tuple(
            replace(e, values={**e.values, **own[e.name]}) if e.name in own else e
            for e in self.effects
        )
        return replace(self, rates={**self.rates, **own.get("rates", {})}, effects=effects)

    def covariance_of(self, names: Sequence[str]) -> Array:
        """Return the covariance (k, k) of some numbers, from their sds where there is no matrix."""
        if self.covariance is None or not set(names) & set(self.covariance_names):
            return np.diag([self.sd(name) ** 2 for name in names])
        place = {name: i for i, name in enumerate(self.covariance_names)}
        rows = np.array([place.get(name, -1) for name in names])
        known = rows >= 0
        full = np.array(self.covariance)[np.ix_(rows, rows)]
        return np.where(np.outer(known, known), full, 0.0)
