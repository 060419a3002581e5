"""`config.yaml`: what the daemon runs, read and bounded once at start.

Names carry units. A key that is not known is an error that suggests the nearest one that is. Keys
of a device that are not its own here are options of its driver; `options:` holds those that are
called like one of ours. Paths are relative to the file, and so are driver options that begin with
`./` or `../`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Self

from pydantic import Field, ValidationError, model_validator

from thermocald.config.devices import (
    CalibrationConfig,
    CameraConfig,
    DeviceConfig,
    OutputConfig,
    Prior,
    SensorConfig,
    ThermometerConfig,
)
from thermocald.config.section import Name, Section, in_words, keys, nearest, wrong
from thermocald.config.service import (
    DashboardConfig,
    ForwardConfig,
    FramesConfig,
    LoggingConfig,
    StoreConfig,
)
from thermocald.errors import ConfigurationError
from thermocald.yaml_file import read_yaml

if TYPE_CHECKING:
    from pathlib import Path

__all__ = [
    "CalibrationConfig",
    "CameraConfig",
    "Config",
    "DashboardConfig",
    "DeviceConfig",
    "ForwardConfig",
    "FramesConfig",
    "LoggingConfig",
    "Name",
    "OutputConfig",
    "Prior",
    "SensorConfig",
    "StoreConfig",
    "ThermometerConfig",
    "load_config",
    "parse_config",
]

# kind of device, driver → names of the driver's options
OptionNames = Callable[[Any, str], Sequence[str]]


class Config(Section):
    """The whole file."""

    store: StoreConfig = Field(default_factory=dict, validate_default=True)
    """Where results go."""
    frames: FramesConfig = Field(default_factory=dict, validate_default=True)
    """Which frames are kept."""
    cameras: tuple[CameraConfig, ...] = ()
    """The cameras."""
    thermometers: tuple[ThermometerConfig, ...] = ()
    """The thermometers."""
    outputs: tuple[OutputConfig, ...] = ()
    """What is told every epoch's result."""
    calibration: CalibrationConfig = CalibrationConfig()
    """How epochs are adjusted."""
    dashboard: DashboardConfig = DashboardConfig()
    """The web page."""
    forward: ForwardConfig = ForwardConfig()
    """A server that gets every row."""
    logging: LoggingConfig = LoggingConfig()
    """The log."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.cameras and not self.thermometers:
            raise wrong("there is neither a camera nor a thermometer; nothing would be done")
        for kind in ("cameras", "thermometers", "outputs"):
            names = [device.name for device in getattr(self, kind)]
            for name in names:
                if names.count(name) > 1:
                    raise wrong(f"{kind}: the name {name!r} is duplicated")
        there = [thermometer.name for thermometer in self.thermometers]
        for camera in self.cameras:
            if camera.name == "status":
                raise wrong("camera 'status': choose another name; the live folder has a status")
            for name in camera.thermometers:
                if name not in there:
                    raise wrong(
                        f"camera {camera.name!r}: there is no thermometer {name!r}"
                        + nearest(name, there)
                    )
        return self

    def calibration_of(self, camera: CameraConfig) -> CalibrationConfig:
        """The settings that hold for a camera."""
        return camera.calibration or self.calibration


def load_config(path: Path, option_names: OptionNames | None = None) -> Config:
    """Read and check `config.yaml`.

    option_names: tells the options of a driver, so that wrong ones are found now and not when the
    device is opened (`thermocald.hal.option_names`). Raises ConfigurationError naming the file, the
    dotted key, the value and the bound.
    """
    return parse_config(read_yaml(path), path, option_names)


def parse_config(
    document: dict[str, Any], path: Path, option_names: OptionNames | None = None
) -> Config:
    """The configuration in a mapping; `path` is what relative paths and messages refer to."""
    try:
        config = Config.model_validate(document, context={"folder": path.absolute().parent})
    except ValidationError as cause:
        raise ConfigurationError(in_words(path, cause)) from cause
    for where, kind, device in _devices(config):
        _check_options(f"{path}: {where}", kind, device, option_names)
    for i, camera in enumerate(config.cameras):
        if camera.testfield is not None and not camera.testfield.is_file():
            raise ConfigurationError(
                f"{path}: cameras[{i}].testfield: there is no file {camera.testfield}"
            )
    return config


def _devices(config: Config) -> Iterator[tuple[str, str, DeviceConfig]]:
    for kind in ("camera", "thermometer", "output"):
        for i, device in enumerate(getattr(config, f"{kind}s")):
            yield f"{kind}s[{i}]", kind, device


def _check_options(
    where: str, kind: str, device: DeviceConfig, option_names: OptionNames | None
) -> None:
    own = keys(type(device))
    if option_names is not None:
        known = list(option_names(kind, device.driver))
        for key in device.options:
            if key not in known:
                raise ConfigurationError(
                    f"{where}.{key}: unknown; neither a key of a {kind} nor an option of driver "
                    f"{device.driver!r}{nearest(key, [*own, *known])}"
                )
        return
    for key in device.model_extra or {}:
        if near := difflib.get_close_matches(key, own, 1, 0.85):
            raise ConfigurationError(f"{where}.{key}: unknown; is {near[0]!r} meant?")
