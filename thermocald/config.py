"""`config.yaml`: what the daemon runs, read and bounded once at start.

Names carry units. A key that is not known is an error that suggests the nearest one that is. Keys
of a device that are not its own here are options of its driver; `options:` holds those that are
called like one of ours. Paths are relative to the file, and so are driver options that begin with
`./` or `../`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args
from urllib.parse import urlsplit

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from thermocald.addresses import hide_secrets, is_loopback, is_secret, without_secrets
from thermocald.errors import ConfigurationError
from thermocald.files import is_ordinary, read_yaml

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Period = Annotated[float, Field(ge=0.05, le=86400.0)]
Positive = Annotated[float, Field(gt=0.0, le=1e9)]


def _folder(info: ValidationInfo) -> Path:
    """Return the folder of the file that is read."""
    found: Path = (info.context or {}).get("folder", Path())
    return found


FilePath = Annotated[Path, AfterValidator(lambda path, info: _folder(info) / path.expanduser())]
"""A path that is relative to the folder of the file."""


def _is_number(annotation: Any) -> bool:
    """Return whether a field holds a number, which may have limits or be missing."""
    parts = (annotation, *get_args(annotation))
    return any(part in (int, float) or get_args(part)[:1] in ((int,), (float,)) for part in parts)


class Section(BaseModel):
    """A part of the file: immutable, finite numbers, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _suggest(cls, data: Any) -> Any:
        if isinstance(data, dict) and cls.model_config["extra"] == "forbid":
            for key in data:
                if key not in cls.model_fields:
                    raise _of_key(str(key), f"unknown{nearest(str(key), list(cls.model_fields))}")
        for key, value in data.items() if isinstance(data, dict) else ():
            known = cls.model_fields.get(key)
            if isinstance(value, bool) and known and _is_number(known.annotation):
                message = f"is {value}, as YAML reads yes, no, on, off; a number is needed"
                raise _of_key(key, message)
        return data


def keys(section: type[Section]) -> list[str]:
    """Return the keys of a section as the file spells them."""
    return [field.alias or name for name, field in section.model_fields.items()]


def wrong(message: str) -> PydanticCustomError:
    """Return an error of ours, for a validator."""
    return PydanticCustomError("thermocald", "{message}", {"message": message})


def _of_key(key: str, message: str) -> PydanticCustomError:
    """Return an error of ours about one key of a section, for a validator of the whole."""
    return PydanticCustomError("of_key", "{message}", {"message": message, "key": key})


def nearest(key: str, known: list[str]) -> str:
    """Return the end of a message: which known key is meant, or which there are."""
    near = difflib.get_close_matches(key, known, 1, 0.5)
    return f"; is {near[0]!r} meant?" if near else f"; known are: {', '.join(known) or 'none'}"


def in_words(path: Path | str, error: ValidationError) -> str:
    """Return the first error, as file or place (or none), dotted key, value and what is allowed."""
    first = error.errors()[0]
    where = "".join(
        f"[{part}]" if isinstance(part, int) else f".{_key(part)}" for part in first["loc"]
    ).lstrip(".")
    place = f"{path}: " if str(path) else ""
    context = first.get("ctx", {})
    if first["type"] == "of_key":
        where = f"{where}.{_key(context['key'])}".lstrip(".")
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    message = without_secrets(first["msg"])
    if first["type"] == "missing":
        message = "is missing"
    elif first["type"] == "value_error":  # of a check that is shared with others
        message = str(context["error"])
    elif first["type"] not in ("thermocald", "of_key"):
        given = "a secret" if is_secret(where.rpartition(".")[2]) else _short(first["input"])
        message = f"is {given}; {message[0].lower()}{message[1:]}"
    return f"{place}{where + ': ' if where else ''}{message}{more}"


def _key(key: str) -> str:
    """Return a key as it stands, or quoted where it is not of letters."""
    return key if key.isprintable() and len(key) <= 60 else _short(key)


def _short(value: Any) -> str:
    text = without_secrets(repr(value))
    return text if len(text) <= 60 else f"{text[:57]}…"


InteriorName = Literal["c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2"]
ParameterName = Literal[InteriorName, "omega", "phi", "kappa", "X0", "Y0", "Z0"]


class SensorConfig(Section):
    """Size of the image and of a pixel."""

    width_px: Annotated[int, Field(ge=16, le=100_000)]
    """Width of the image."""
    height_px: Annotated[int, Field(ge=16, le=100_000)]
    """Height of the image."""
    pixel_pitch_mm: Annotated[float, Field(ge=1e-4, le=0.1)]
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
    snooping_alpha: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0005
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
        own = set(keys(cls)) - {"options"}
        return {k: v if k in own else _resolved(v, _folder(info)) for k, v in data.items()}


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
    acquired; thermal_model: in place of a test field, the camera is predicted and, with control
    points, posed; calibration: what differs from the common settings is given in full.
    """

    period_s: Period = 10.0
    """Time between frames."""
    series: Name | None = "watch"
    """Name of the measurement series."""
    sensor: SensorConfig | None = None
    """Size of the image and of a pixel."""
    principal_distance_mm: Annotated[float, Field(ge=0.1, le=10_000.0)] | None = None
    """Nominal; helps to find a first orientation."""
    testfield: FilePath | None = None
    """A testfield.csv; without it frames are only taken."""
    thermal_model: FilePath | None = None
    """In place of a test field: the camera is predicted from its thermometers."""
    control_points: FilePath | None = None
    """With a thermal model: surveyed points that give its pose in each frame."""
    control_unit: Literal["mm", "m"] = "m"
    """Of the control points' coordinates in a CSV."""
    control_reference: FilePath | None = None
    """A frame in which the control points' x, y are; without it they are coded targets."""
    mount_sd_deg: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    """How far the mount turns about an axis in an hour; None: not known."""
    thermometers: tuple[Name, ...] = ()
    """By name; the first is the reference."""
    calibration: CalibrationConfig | None = None
    """Of this camera, in full, in place of the common one."""

    @model_validator(mode="after")
    def _one_task(self) -> Self:
        if self.thermal_model is None:
            for key in ("control_points", "control_reference", "mount_sd_deg"):
                if getattr(self, key) is not None:
                    raise wrong(f"`{key}` needs a `thermal_model`")
        elif self.testfield is not None:
            raise wrong("either `testfield` or `thermal_model`: calibrated or predicted")
        elif not self.thermometers:
            raise wrong("`thermal_model` needs `thermometers`, the reference first")
        if self.control_points is None and self.control_reference is not None:
            raise wrong("`control_reference` needs `control_points`")
        return self


def _resolved(value: Any, folder: Path) -> Any:
    """Return a driver's option with paths made absolute, also within lists and mappings."""
    if isinstance(value, str) and re.match(r"\.\.?/", value):
        return str(folder / value)
    if isinstance(value, list):
        return [_resolved(entry, folder) for entry in value]
    if isinstance(value, dict):
        return {key: _resolved(entry, folder) for key, entry in value.items()}
    return value


class StoreConfig(Section):
    """Where results go. durable: what is stored survives a power cut, at the price of a sync."""

    path: FilePath = Field(default=Path("thermocald.db"), validate_default=True)
    """The SQLite file."""
    durable: bool = True
    """What is stored survives a power cut; false: only the end of the process, but faster."""


class FramesConfig(Section):
    """Which frames are kept, where, and for how long; None: no limit."""

    keep: Literal["all", "every_n", "events", "none"] = "every_n"
    """Which frames are kept; events: knock, slip, failed epochs."""
    every_n: Annotated[int, Field(ge=1, le=1_000_000)] = 360
    """With every_n: one of so many."""
    corrected: bool = False
    """Cameras with a thermal_model: each kept frame a second time, as it had been at T₀."""
    folder: FilePath = Field(default=Path("frames"), validate_default=True)
    """Where they are kept."""
    max_age_days: Positive | None = 90.0
    """Older frames are deleted, which is logged; null: no limit."""
    max_size_gb: Positive | None = 8.0
    """Beyond it the oldest frames go first; null: no limit."""
    min_free_gb: Annotated[float, Field(ge=0.0, le=1e6)] = 0.5
    """With less room on the disk no frame is kept."""


class DashboardConfig(Section):
    """The web page; elsewhere than on this machine it needs a token."""

    enabled: bool = False
    """Whether the daemon shows the page."""
    host: str = "127.0.0.1"
    """Elsewhere than on this machine a token_file is needed."""
    port: Annotated[int, Field(ge=1, le=65535)] = 8437
    """Of the page."""
    token_file: FilePath | None = None
    """A file that holds the token; others must not be able to read it."""
    names: tuple[Annotated[str, Field(min_length=1, max_length=253)], ...] = ()
    """Further names by which the page may be asked for, such as that of a proxy."""

    @model_validator(mode="after")
    def _guarded(self) -> Self:
        if not is_loopback(self.host) and self.token_file is None:
            raise wrong(f"host {self.host} is open to others; name a token_file too")
        return self


class ForwardConfig(Section):
    """Where the store's rows are sent, by a process of its own: `thermocald forward`."""

    to: Annotated[str, Field(pattern=r"^postgres(ql)?://")] | None = None
    """The server, postgresql://USER@HOST/DATABASE; null: nothing is sent."""
    station: Name | None = None
    """This station's name there; null: the host's."""
    frames: Literal["none", "events", "every_n", "all"] = "none"
    """Which of the kept frames are sent too; events: epochs without a result, and movements."""
    every_n: Annotated[int, Field(ge=1, le=1_000_000)] = 360
    """With frames: every_n, those whose number it divides."""
    frames_mb_per_day: Positive = 200.0
    """Frames beyond it wait for the next day."""

    @field_validator("to")
    @classmethod
    def _without_password(cls, value: str | None) -> str | None:
        try:
            parts = urlsplit(value or "")
            _ = parts.port
        except ValueError:
            raise wrong("is not a valid address: postgresql://USER@HOST/DATABASE") from None
        if parts.password is not None or "password=" in parts.query:
            raise wrong("holds a password; write it to the service's ~/.pgpass, or use passfile=")
        return value


class LoggingConfig(Section):
    """What goes to the journal."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """From which on messages go to the journal."""


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
        if self.frames.corrected and not any(c.thermal_model for c in self.cameras):
            raise wrong("frames.corrected needs a camera with a thermal_model")
        return self

    def calibration_of(self, camera: CameraConfig) -> CalibrationConfig:
        """Return the settings that hold for a camera."""
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
    hide_secrets(document)
    try:
        config = Config.model_validate(document, context={"folder": path.absolute().parent})
    except ValidationError as cause:
        raise ConfigurationError(in_words(path, cause)) from cause
    for kind in ("camera", "thermometer", "output"):
        for i, device in enumerate(getattr(config, f"{kind}s")):
            _check_options(f"{path}: {kind}s[{i}]", kind, device, option_names)
    for i, camera in enumerate(config.cameras):
        for key in ("testfield", "thermal_model", "control_points", "control_reference"):
            file = getattr(camera, key)
            if file is not None and not file.is_file():
                raise ConfigurationError(f"{path}: cameras[{i}].{key}: there is no file {file}")
    _check_places(config, path)
    return config


def _check_places(config: Config, path: Path) -> None:
    """Refuse outputs that write into one another, into the store, or into the configuration."""
    store = config.store.path
    taken = {
        "the store": [store, *(store.with_name(f"{store.name}-{x}") for x in ("wal", "shm"))],
        "the configuration": [path],
    }
    for i, output in enumerate(config.outputs):
        place = output.options.get("path")
        if not isinstance(place, str) or "\0" in place:
            continue
        if Path(place).exists() and not is_ordinary(Path(place)):  # several may write to a device
            continue
        for what, files in taken.items():
            if any(_same_file(Path(place), file) for file in files):
                raise ConfigurationError(
                    f"{path}: outputs[{i}].path: {place}: is {what}; choose another file"
                )
        taken[f"what {output.name} writes"] = [Path(place)]
    for what, files in taken.items():
        if any(_same_file(config.frames.folder, file) for file in files):
            raise ConfigurationError(f"{path}: frames.folder: is {what}; choose another folder")
    if _same_file(store, path):
        raise ConfigurationError(f"{path}: store.path: is the configuration; choose another file")


def _same_file(one: Path, other: Path) -> bool:
    """Return whether two paths lead to one file, by links of either kind, there or not."""
    try:
        return one.samefile(other)
    except OSError:
        return one.resolve() == other.resolve()


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
