"""The daemon's configuration, `config.yaml`, read and checked once at the start.

A key's name includes its unit. An unknown key is an error that suggests the nearest known one. Keys
of a device's stanza that are not defined here are options of its driver; `options:` takes driver
options whose names are defined here. Paths are relative to the file, and so are driver options that
begin with `./` or `../`.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args
from urllib.parse import urlsplit

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
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

_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
_SERVER = r"^postgres(ql)?://"
Name = Annotated[str, Field(pattern=_NAME)]
Period = Annotated[float, Field(ge=0.05, le=86400.0)]
Positive = Annotated[float, Field(gt=0.0, le=1e9)]


def _folder(info: ValidationInfo) -> Path:
    """Return the configuration file's folder."""
    folder: Path = (info.context or {}).get("folder", Path())
    return folder


def _not_empty(path: Any) -> Any:
    if path == "":  # as a Path it would be the current folder
        raise PydanticCustomError("string_too_short", "empty")
    return path


FilePath = Annotated[
    Path,
    BeforeValidator(_not_empty),
    # Path's own `expanduser` raises for ~nobody
    AfterValidator(lambda path, info: _folder(info) / os.path.expanduser(path)),
]
"""A path relative to the file's folder."""


class Section(BaseModel):
    """A section of the file: immutable, with finite numbers and without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _suggest(cls, data: Any) -> Any:
        for key, value in data.items() if isinstance(data, dict) else ():
            known = cls.model_fields.get(key)
            if known is None and cls.model_config["extra"] == "forbid":
                raise _of_key(str(key), f"unknown{nearest(str(key), list(cls.model_fields))}")
            # a number or a mapping to numbers, with limits and None or without
            kinds = (known.annotation, *get_args(known.annotation)) if known else ()
            if not any(k in (int, float) or get_args(k)[:1] in ((int,), (float,)) for k in kinds):
                continue
            for name, one in value.items() if isinstance(value, dict) else [(None, value)]:
                if isinstance(one, bool):
                    raise _of_key(
                        key if name is None else f"{key}.{name}",
                        f"is {_short(one)}, as YAML reads yes, no, on, off; a number is needed",
                    )
        return data


def keys(section: type[Section]) -> list[str]:
    """Return a section's keys as the file spells them."""
    return [field.alias or name for name, field in section.model_fields.items()]


def wrong(message: str) -> PydanticCustomError:
    """Return the error that a validator raises with this program's own message."""
    return PydanticCustomError("thermocald", "{message}", {"message": message})


def _of_key(key: str, message: str) -> PydanticCustomError:
    """Return the error that a section's validator raises about one of its keys."""
    return PydanticCustomError("of_key", "{message}", {"message": message, "key": key})


def nearest(key: str, known: list[str]) -> str:
    """Return the end of a message: the known key that may be meant, or all known keys."""
    lower = {name.lower(): name for name in known}
    near = difflib.get_close_matches(key.lower(), lower, 1, 0.5)
    return (
        f"; is {lower[near[0]]!r} meant?" if near else f"; known are: {', '.join(known) or 'none'}"
    )


_LIST = "must be a list: [a, b], or lines that begin with `- `"
_LINES = "must hold `key: value` lines"
# pydantic's words are those of Python, whose types a configuration does not name
_RULES = {
    _NAME: "must be a letter or digit, then up to 63 letters, digits, `_`, `.`, `-`",
    _SERVER: "must begin with postgresql://",
    **dict.fromkeys(("list_type", "tuple_type"), _LIST),
    **dict.fromkeys(("dict_type", "mapping_type", "model_type"), _LINES),
    **dict.fromkeys(("bool_parsing", "bool_type"), "must be true or false"),
    "path_type": "must be a path; put it in quotes",
    **dict.fromkeys(("float_type", "float_parsing"), "must be a number, without a unit"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "must be a whole number"),
    **dict.fromkeys(("int_parsing_size", "finite_number"), "must be a finite number"),
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than_equal": "must be at most {le:g}",
    "literal_error": "must be {expected}",
    "string_too_short": "must not be empty",
    "string_type": "must be text; put it in quotes",
    "too_long": "must list at most {max_length}",
    "too_short": "must list at least {min_length}",
}


def in_words(path: Path | str, error: ValidationError) -> str:
    """Return the first error as a message: file or place, if any, dotted key, value and bounds."""
    first = error.errors()[0]
    where = "".join(
        f"[{part}]" if isinstance(part, int) else f".{_key(part)}"
        for part in first["loc"]
        if part != "[key]"  # pydantic's mark of an error in the key itself
    ).lstrip(".")
    place = f"{path}: " if str(path) else ""
    context = first.get("ctx", {})
    if first["type"] == "of_key":
        where = f"{where}.{_key(context['key'])}".lstrip(".")
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    message = without_secrets(first["msg"])
    if first["type"] == "missing":
        message = "is missing"
    elif first["type"] == "value_error":  # a check shared with other readers
        message = str(context["error"])
    elif first["type"] not in ("thermocald", "of_key"):
        given = "a secret" if is_secret(where.rpartition(".")[2]) else _short(first["input"])
        if rule := _RULES.get(context.get("pattern") or first["type"]):
            message = rule.format(**context)
            if isinstance(first["input"], list | dict):
                message = message.removesuffix("; put it in quotes")
        message = f"is {given}; {message[0].lower()}{message[1:]}"
    return f"{place}{where + ': ' if where else ''}{message}{more}"


def _key(key: str) -> str:
    """Return a key, quoted if it is long or holds characters that cannot be printed."""
    return key if key.isprintable() and len(key) <= 60 else _short(key)


def _short(value: Any) -> str:
    if value is None:
        return "empty"
    written = str(value).lower() if isinstance(value, bool | date) else repr(value)
    text = without_secrets(written)
    return text if len(text) <= 60 else f"{text[:57]}…"


InteriorName = Literal["c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2"]
ParameterName = Literal[InteriorName, "omega", "phi", "kappa", "X0", "Y0", "Z0"]


class SensorConfig(Section):
    """The size of the image and of a pixel."""

    width_px: Annotated[int, Field(ge=16, le=100_000)]
    """Image width."""
    height_px: Annotated[int, Field(ge=16, le=100_000)]
    """Image height."""
    pixel_pitch_mm: Annotated[float, Field(ge=1e-4, le=0.1)]
    """Pixel pitch."""


class Prior(Section):
    """A parameter's prior value and its standard deviation, in the parameter's unit."""

    value: float
    """Prior value."""
    sd: Annotated[float, Field(gt=0.0)]
    """Standard deviation of the prior value."""


class CalibrationConfig(Section):
    """The settings of the adjustment of epochs.

    Each epoch is stored with its own result and with its result in the series. exterior: the
    exterior orientation in the series: one `per_epoch`, one for the whole `series` of a camera that
    stands still, or one and movements of the `mount`, whose size is estimated from the epochs;
    `auto` chooses from the epochs so far. target_offsets: estimate a constant offset per target
    from all epochs so far, with the test field's sigmas as prior; otherwise the sigmas count as
    noise of each epoch. free: the parameters estimated; fixed: values of the others; priors: prior
    values with their sds; the bounds are those of `photogrammetry.geometry`.
    """

    exterior: Literal["auto", "mount", "per_epoch", "series"] = "auto"
    """Exterior orientation: one per epoch, one for the series, or one and the mount's movements."""
    free: tuple[InteriorName, ...] = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
    """Parameters of the interior orientation that are estimated."""
    fixed: dict[InteriorName, float] = Field(default_factory=dict)
    """Values of the parameters that are not estimated; 0 if not given."""
    priors: dict[ParameterName, Prior] = Field(default_factory=dict)
    """Prior values of parameters, each in its unit."""
    sigma_floor_px: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    """Lower bound of an image point's standard deviation."""
    target_offsets: bool = True
    """In the series, estimate a constant offset per target, of up to 400 in view."""
    correlation_bound: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.9999
    """Correlation between parameters above which an epoch's geometry counts as weak."""
    snooping_alpha: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0005
    """Probability that snooping rejects a good observation; 0: no snooping."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if both := set(self.free) & set(self.fixed):
            raise wrong(f"{min(both)} is both in `free` and in `fixed`")
        if len(set(self.free)) != len(self.free):
            raise wrong("`free` names a parameter twice")
        stated = [*self.fixed.items(), *((name, p.value) for name, p in self.priors.items())]
        for name, c in stated:
            if name == "c" and not 0.1 <= c <= 10_000.0:
                raise wrong(f"c is {c:g}; a principal distance is within 0.1 … 10,000 mm")
        return self


class DeviceConfig(Section):
    """A device: its name, its driver (an entry point) and the driver's options."""

    model_config = ConfigDict(extra="allow")

    name: Name
    """The device's name, unique in its list; letters, digits, _ . -."""
    driver: Annotated[str, Field(min_length=1)]
    """The name of an installed driver (entry point)."""
    driver_options: dict[str, Any] = Field(default_factory=dict, alias="options")
    """Options of the driver that have the name of a key of this section."""

    @property
    def options(self) -> dict[str, Any]:
        """The options for the driver's constructor."""
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
    """A device that receives every epoch's result."""


class CameraConfig(DeviceConfig):
    """A camera, its known properties and its test field or thermal model.

    series: the series that it takes when no session runs; None: none, and the device is closed.
    thermometers: by name, the reference first. testfield: None if epochs are only acquired.
    thermal_model: in place of a test field; the camera is predicted and, with control points,
    posed. calibration: replaces the common settings as a whole.
    """

    period_s: Period = 10.0
    """Time between frames."""
    series: Name | None = "watch"
    """Name of the measurement series."""
    sensor: SensorConfig | None = None
    """The size of the image and of a pixel."""
    principal_distance_mm: Annotated[float, Field(ge=0.1, le=10_000.0)] | None = None
    """Nominal principal distance; helps to find a first orientation."""
    testfield: FilePath | None = None
    """A testfield.csv; if not given, frames are taken but not calibrated."""
    thermal_model: FilePath | None = None
    """In place of a test field: the model that predicts the camera from its thermometers."""
    control_points: FilePath | None = None
    """With a thermal model: control points, from which each frame's pose is estimated."""
    control_unit: Literal["mm", "m"] = "m"
    """Unit of the control points' coordinates in a CSV."""
    control_reference: FilePath | None = None
    """A frame for which x, y of the control points are given; if not given, they are coded
    targets."""
    mount_sd_deg: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    """Standard deviation of the mount's rotation about an axis in an hour; null: unknown."""
    thermometers: tuple[Name, ...] = ()
    """Names of its thermometers, the reference first."""
    calibration: CalibrationConfig | None = None
    """This camera's settings of the adjustment, which replace the common ones as a whole."""

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
        if self.testfield is not None and self.sensor is None:
            raise wrong(
                "`testfield` needs `sensor: {width_px: …, height_px: …, pixel_pitch_mm: …}`"
            )
        return self


def _resolved(value: Any, folder: Path) -> Any:
    """Return a driver's option with its paths made absolute, in lists and mappings too."""
    if isinstance(value, str) and re.match(r"\.\.?/", value):
        return str(folder / value)
    if isinstance(value, list):
        return [_resolved(entry, folder) for entry in value]
    if isinstance(value, dict):
        return {key: _resolved(entry, folder) for key, entry in value.items()}
    return value


class StoreConfig(Section):
    """The store of the results."""

    path: FilePath = Field(default=Path("thermocald.db"), validate_default=True)
    """The SQLite file."""
    durable: bool = True
    """Sync each write, so that it survives a power cut; false: faster, survives only a crash."""


class FramesConfig(Section):
    """Which frames are kept, where, and for how long."""

    keep: Literal["all", "every_n", "events", "none"] = "every_n"
    """Which frames are kept; events: those of a knock, a slip or a failed epoch."""
    every_n: Annotated[int, Field(ge=1, le=1_000_000)] = 360
    """With keep: every_n, one frame in so many is kept."""
    corrected: bool = False
    """For cameras with a thermal_model, also store each kept frame corrected to T₀."""
    folder: FilePath = Field(default=Path("frames"), validate_default=True)
    """Folder of the kept frames."""
    max_age_days: Positive | None = 90.0
    """Older frames are deleted, which is logged; null: no limit."""
    max_size_gb: Positive | None = 8.0
    """Total size above which the oldest frames are deleted; null: no limit."""
    min_free_gb: Annotated[float, Field(ge=0.0, le=1e6)] = 0.5
    """Free disk space below which no frame is kept."""


class DashboardConfig(Section):
    """The web page, which needs a token if other machines can reach it."""

    enabled: bool = False
    """Whether the daemon serves the page."""
    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    """Address to listen on; one that other machines can reach needs a token_file."""
    port: Annotated[int, Field(ge=1, le=65535)] = 8437
    """Port to listen on."""
    token_file: FilePath | None = None
    """A file with the token; other users must not be able to read it."""
    names: tuple[Annotated[str, Field(min_length=1, max_length=253)], ...] = ()
    """Further host names of the page, for example a proxy's."""

    @model_validator(mode="after")
    def _guarded(self) -> Self:
        if not is_loopback(self.host) and self.token_file is None:
            raise wrong(f"host {self.host} is open to other machines; give a token_file too")
        return self


class ForwardConfig(Section):
    """The server to which `thermocald forward`, a separate process, sends the store's rows."""

    to: Annotated[str, Field(pattern=_SERVER)] | None = None
    """The server, postgresql://USER@HOST/DATABASE; null: nothing is sent."""
    station: Name | None = None
    """The station's name on the server; null: the host's."""
    frames: Literal["none", "events", "every_n", "all"] = "none"
    """Which kept frames are sent too; events: those of movements and of epochs without a result."""
    every_n: Annotated[int, Field(ge=1, le=1_000_000)] = 360
    """With frames: every_n, frames are sent whose number is a multiple of it."""
    frames_mb_per_day: Positive = 200.0
    """Frames sent in a day at most; the others wait for the next day."""

    @field_validator("to")
    @classmethod
    def _without_password(cls, value: str | None) -> str | None:
        try:
            parts = urlsplit(value or "")
            _ = parts.port
        except ValueError:
            raise wrong("is not a valid address: postgresql://USER@HOST/DATABASE") from None
        if parts.password is not None or "password=" in parts.query:
            raise wrong("holds a password; put it into the service's ~/.pgpass, or use passfile=")
        return value


class LoggingConfig(Section):
    """The journal."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level of the messages in the journal."""


# (kind of device, driver) → the driver's class
LoadDriver = Callable[[Any, str], type[Any]]


class Config(Section):
    """The whole file."""

    store: StoreConfig = Field(default_factory=dict, validate_default=True)
    """The store of the results."""
    frames: FramesConfig = Field(default_factory=dict, validate_default=True)
    """Which frames are kept."""
    cameras: tuple[CameraConfig, ...] = ()
    """The cameras."""
    thermometers: tuple[ThermometerConfig, ...] = ()
    """The thermometers."""
    outputs: tuple[OutputConfig, ...] = ()
    """The outputs, which receive every epoch's result."""
    calibration: CalibrationConfig = CalibrationConfig()
    """The settings of the adjustment of epochs."""
    dashboard: DashboardConfig = DashboardConfig()
    """The web page."""
    forward: ForwardConfig = ForwardConfig()
    """The server to which the store's rows are sent."""
    logging: LoggingConfig = LoggingConfig()
    """The journal."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.cameras and not self.thermometers:
            raise wrong("there is neither a camera nor a thermometer; configure at least one")
        for kind in ("cameras", "thermometers", "outputs"):
            names = [device.name for device in getattr(self, kind)]
            for name in names:
                if names.count(name) > 1:
                    raise wrong(f"{kind}: the name {name!r} is duplicated")
        known = [thermometer.name for thermometer in self.thermometers]
        for camera in self.cameras:
            if camera.name == "status":
                raise wrong("camera 'status': choose another name; the live folder uses this one")
            for name in camera.thermometers:
                if name not in known:
                    raise wrong(
                        f"camera {camera.name!r}: there is no thermometer {name!r}"
                        + nearest(name, known)
                    )
            if len(set(camera.thermometers)) != len(camera.thermometers):
                raise wrong(f"camera {camera.name!r}: `thermometers` names one twice")
        if self.frames.corrected and not any(c.thermal_model for c in self.cameras):
            raise wrong("frames.corrected needs a camera with a thermal_model")
        return self


def load_config(path: Path, load_driver: LoadDriver | None = None) -> Config:
    """Read and check `config.yaml`.

    load_driver: `thermocald.hal.load_driver`, to check drivers and their options before a device is
    opened. Raises ConfigurationError, which names the file, the dotted key, the value and the
    bound.
    """
    return parse_config(read_yaml(path), path, load_driver)


def parse_config(
    document: dict[str, Any], path: Path, load_driver: LoadDriver | None = None
) -> Config:
    """Check a configuration given as a mapping; relative paths and messages refer to `path`."""
    hide_secrets(document)
    if "format" in document:
        raise ConfigurationError(f"{path}: is a {document['format']} file, not a configuration")
    try:
        config = Config.model_validate(document, context={"folder": path.absolute().parent})
    except ValidationError as cause:
        raise ConfigurationError(in_words(path, cause)) from cause
    for kind in ("camera", "thermometer", "output"):
        for i, device in enumerate(getattr(config, f"{kind}s")):
            _check_options(f"{path}: {kind}s[{i}]", kind, device, load_driver)
    for i, camera in enumerate(config.cameras):
        for key in ("testfield", "thermal_model", "control_points", "control_reference"):
            file = getattr(camera, key)
            if file is not None and not (os.path.isfile(file) and os.access(file, os.R_OK)):
                why = f"there is no file {file} that can be read"
                raise ConfigurationError(f"{path}: cameras[{i}].{key}: {why}")
    _check_places(config, path)
    return config


def _check_places(config: Config, path: Path) -> None:
    """Refuse outputs that write to each other's file, the store or the configuration."""
    store = config.store.path
    taken = {
        "the store": [store, *(store.with_name(f"{store.name}-{x}") for x in ("wal", "shm"))],
        "the configuration": [path],
    }
    for i, output in enumerate(config.outputs):
        place = output.options.get("path")
        if not isinstance(place, str) or "\0" in place:
            continue
        if os.path.exists(place) and not is_ordinary(Path(place)):  # several may write to a device
            continue
        for what, files in taken.items():
            if any(_same_file(Path(place), file) for file in files):
                raise ConfigurationError(
                    f"{path}: outputs[{i}].path: {place}: is {what}; choose another file"
                )
        taken[f"the file of output {output.name}"] = [Path(place)]
    for what, files in taken.items():
        if any(_same_file(config.frames.folder, file) for file in files):
            raise ConfigurationError(f"{path}: frames.folder: is {what}; choose another folder")
    if _same_file(store, path):
        raise ConfigurationError(f"{path}: store.path: is the configuration; choose another file")


def _same_file(one: Path, other: Path) -> bool:
    """Return whether two paths lead to one file, which need not exist, through links or not."""
    try:
        return one.samefile(other)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(other)


def _check_options(
    where: str, kind: str, device: DeviceConfig, load_driver: LoadDriver | None
) -> None:
    own = keys(type(device))
    if load_driver is not None:
        try:
            options = load_driver(kind, device.driver).Options
        except ConfigurationError as error:
            raise ConfigurationError(f"{where}.driver: {error}") from error
        known = keys(options)
        for key in device.options:
            if key not in known:
                raise ConfigurationError(
                    f"{where}.{key}: unknown; neither a key of this {kind} nor an option of "
                    f"driver {device.driver!r}{nearest(key, [*own, *known])}"
                )
        options.read(device.options, where)
        return
    for key in device.model_extra or {}:
        if near := difflib.get_close_matches(key, own, 1, 0.85):
            raise ConfigurationError(f"{where}.{key}: unknown; is {near[0]!r} meant?")
