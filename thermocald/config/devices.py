"""The devices of the configuration, and how a camera's epochs are adjusted."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, ValidationInfo, field_validator, model_validator

from thermocald.config.section import Name, Period, Section, keys, relative_to_file, wrong

InteriorName = Literal["c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2"]
ParameterName = Literal[InteriorName, "omega", "phi", "kappa", "X0", "Y0", "Z0"]


class SensorConfig(Section):
    """Size of the image and of a pixel."""

    width_px: Annotated[int, Field(ge=16, le=100_000)]
    """Width of the image."""
    height_px: Annotated[int, Field(ge=16, le=100_000)]
    """Height of the image."""
    pixel_pitch_mm: Annotated[float, Field(gt=0.0, le=0.1)]
    """Size of a pixel."""


class Prior(Section):
    """A value known beforehand, with its standard deviation, in the parameter's unit."""

    value: float
    """What is known beforehand."""
    sd: Annotated[float, Field(gt=0.0)]
    """Its standard deviation."""


class CalibrationConfig(Section):
    """How epochs are adjusted.

    exterior: how an epoch's result in its series is estimated, which is stored next to its own:
    one orientation `per_epoch`, or one for the `series` of a camera that stands still, or that and
    movements of the `mount` whose size the epochs show; `auto`: what the epochs so far show;
    target_offsets: a constant offset per target, estimated from all epochs so far with the test
    field's sigmas as prior, else these are noise of each epoch;
    free: what is estimated; fixed: values of what is not; priors: values with their sd; the
    bounds as in `photogrammetry.geometry`.
    """

    exterior: Literal["auto", "mount", "per_epoch", "series"] = "auto"
    """One orientation per epoch or for the series, or one and movements of the mount."""
    free: tuple[InteriorName, ...] = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
    """Interior parameters that are estimated."""
    fixed: dict[InteriorName, float] = Field(default_factory=dict)
    """Values of those that are not; 0 where none is given."""
    priors: dict[ParameterName, Prior] = Field(default_factory=dict)
    """By parameter, in its unit."""
    sigma_floor_px: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    """Image points are taken as no better than this."""
    target_offsets: bool = True
    """With series: a constant offset per target, for an imperfect field."""
    correlation_bound: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.9999
    """Above it an epoch's geometry is called weak."""
    snooping_alpha: Annotated[float, Field(ge=0.0, le=0.1)] = 0.001
    """Probability that the test rejects a single good observation; 0: no test."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if both := set(self.free) & set(self.fixed):
            raise wrong(f"{min(both)} stands in `free` and in `fixed`")
        if len(set(self.free)) != len(self.free):
            raise wrong("`free` names a parameter twice")
        return self


class DeviceConfig(Section):
    """A device: a name for people, a driver (an entry point), and the driver's options."""

    model_config = ConfigDict(extra="allow")

    name: Name
    """For people; letters, digits, _ . -; unique in its list."""
    driver: Annotated[str, Field(min_length=1)]
    """An installed entry point; `thermocald devices` lists them."""
    driver_options: dict[str, Any] = Field(default_factory=dict, alias="options")
    """Options of the driver that are called like a key of ours."""

    @property
    def options(self) -> dict[str, Any]:
        """What the driver's constructor gets."""
        return {**(self.model_extra or {}), **self.driver_options}

    @model_validator(mode="before")
    @classmethod
    def _resolve(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, dict):
            return data
        folder: Path = (info.context or {}).get("folder", Path())
        own = keys(cls)
        resolved = {k: v if k in own else _resolved(v, folder) for k, v in data.items()}
        if isinstance(data.get("options"), dict):
            resolved["options"] = _resolved(data["options"], folder)
        return resolved


class ThermometerConfig(DeviceConfig):
    """A thermometer and how often it is read."""

    period_s: Period = 10.0
    """Time between readings."""


class OutputConfig(DeviceConfig):
    """Something that is told every epoch's result."""


class CameraConfig(DeviceConfig):
    """A camera, what is known of it, and what it looks at.

    series: what it takes when no session runs, None for nothing: the device is closed then.
    thermometers: by name, the first is the reference; testfield: None if epochs are only
    acquired; calibration: what differs from the common settings is given in full.
    """

    period_s: Period = 10.0
    """Time between frames."""
    series: Name | None = "watch"
    """Name of the measurement series."""
    sensor: SensorConfig | None = None
    """Size of the image and of a pixel."""
    principal_distance_mm: Annotated[float, Field(gt=0.0, le=10_000.0)] | None = None
    """Nominal; helps to find a first orientation."""
    testfield: Path | None = None
    """A testfield.csv; without it frames are only taken."""
    thermometers: tuple[Name, ...] = ()
    """By name; the first is the reference."""
    calibration: CalibrationConfig | None = None
    """Of this camera, in full, in place of the common one."""

    _testfield = field_validator("testfield")(relative_to_file)


def _resolved(value: Any, folder: Path) -> Any:
    """A driver's option with paths made absolute, also within lists and mappings."""
    if isinstance(value, str) and re.match(r"\.\.?/", value):
        return str(folder / value)
    if isinstance(value, list):
        return [_resolved(entry, folder) for entry in value]
    if isinstance(value, dict):
        return {key: _resolved(entry, folder) for key, entry in value.items()}
    return value
