"""Objects made from a configuration: devices, calibrators and the head of a series.

Also ready-made configurations: a rendered camera, and a recording as devices.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.acquisition.calibrator import Calibrator
from thermocald.acquisition.thermometers import require_columns
from thermocald.config import parse_config
from thermocald.errors import ConfigurationError, RecordingError, ThermocaldError
from thermocald.hal import load_driver, open_device
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import TestField, same_targets
from thermocald.store.database.store import Store
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.reader import open_recording
from thermocald.store.recording.testfield_file import read_testfield

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from thermocald.analysis.online.running_series import RunningSeries
    from thermocald.analysis.thermal.correction import FrameCorrector
    from thermocald.analysis.thermal.gauge import GaugeCalibrator
    from thermocald.config import CalibrationConfig, CameraConfig, Config
    from thermocald.hal import Camera, Clock, Frame
    from thermocald.store.series import StoredSeries

_UNKNOWN_PITCH_MM = 0.001


@dataclass(frozen=True, eq=False)
class CameraPlan:
    """A camera of the configuration, ready to be started.

    series: its current series, empty for none; sensor, calibrator: None if its epochs are acquired
    without calibration; extra: further entries for the head of a series; corrector: None if no
    corrected frames are stored.
    """

    config: CameraConfig
    calibration: CalibrationConfig
    camera: Camera
    sensor: Sensor | None
    calibrator: Calibrator | GaugeCalibrator | None
    series: str
    extra: Mapping[str, Any] = field(default_factory=dict)
    corrector: FrameCorrector | None = None

    @property
    def name(self) -> str:
        return self.config.name

    @property
    def testfield(self) -> TestField | None:
        """The targets, or the control points of a gauge; None without calibration."""
        return None if self.calibrator is None else self.calibrator.testfield

    def calibrator_of_check(self) -> Calibrator:
        """Return the calibrator that checks a frame; ConfigurationError without a test field."""
        if isinstance(self.calibrator, Calibrator):
            return self.calibrator
        raise ConfigurationError(
            f"camera {self.name!r}: the check needs its `testfield`; set it, or give --no-check"
        )


def plan_cameras(config: Config, clock: Clock) -> list[CameraPlan]:
    """Plan the cameras without opening them; raises ConfigurationError."""
    return [_plan(config, camera, clock) for camera in config.cameras]


def _plan(config: Config, one: CameraConfig, clock: Clock) -> CameraPlan:
    camera: Camera = open_device("camera", one.driver, one.options, clock)
    calibration = one.calibration or config.calibration
    if one.thermal_model is not None:
        return _plan_gauge(one, calibration, camera, corrected=config.frames.corrected)
    sensor, targets = _sensor(one), None
    try:
        scene = camera.known_scene()
    except ThermocaldError as error:
        raise ConfigurationError(f"camera {one.name!r}: driver {one.driver!r}: {error}") from error
    if one.testfield is not None:
        targets = read_testfield(one.testfield)
    elif scene is not None:
        targets, sensor = scene[1], sensor or scene[0]
    _check_size(one, camera, sensor)
    calibrator = None
    if targets is not None and sensor is not None:
        calibrator = Calibrator(
            sensor,
            targets,
            AdjustmentSettings(
                free=tuple(calibration.free),
                priors={name: (p.value, p.sd) for name, p in calibration.priors.items()},
                snooping_alpha=calibration.snooping_alpha,
                correlation_bound=calibration.correlation_bound,
            ),
            nominal_c=one.principal_distance_mm,
            interior=_held(one, calibration),
            sigma_floor_px=calibration.sigma_floor_px,
        )
    return CameraPlan(one, calibration, camera, sensor, calibrator, one.series or "")


def _plan_gauge(
    one: CameraConfig, calibration: CalibrationConfig, camera: Camera, *, corrected: bool
) -> CameraPlan:
    """Plan a camera whose thermal model predicts its calibration and control points its pose."""
    from thermocald.analysis.thermal.correction import FrameCorrector
    from thermocald.analysis.thermal.gauge import plan_gauge
    from thermocald.analysis.thermal.thermal_camera import load_camera

    assert one.thermal_model is not None
    thermal = load_camera(one.thermal_model)
    sensor = _sensor(one) or thermal.model.sensor
    _check_size(one, camera, sensor)
    thermal = thermal.for_images(sensor.width, sensor.height)
    gauge, origin = plan_gauge(
        thermal, one.control_points, one.control_unit, one.control_reference, one.mount_sd_deg,
        calibration.snooping_alpha,
    )  # fmt: skip
    extra: dict[str, Any] = {"thermal_model": thermal.model.name or thermal.model.camera}
    if len(gauge.testfield):
        extra["control_origin_mm"] = origin
    return CameraPlan(
        one, calibration, camera, gauge.sensor, gauge, one.series or "", extra,
        FrameCorrector(thermal, one.name, origin) if corrected else None,
    )  # fmt: skip


def _check_size(one: CameraConfig, camera: Camera, sensor: Sensor | None) -> None:
    """Raise ConfigurationError if the sensor and the driver's frames differ in size."""
    size = camera.frame_size()
    if sensor is not None and size is not None and size != (sensor.width, sensor.height):
        raise ConfigurationError(
            f"camera {one.name!r}: sensor has {sensor.width}×{sensor.height} px, but the driver's "
            f"frames have {size[0]}×{size[1]} px (its width and height); make them equal"
        )


def _sensor(one: CameraConfig) -> Sensor | None:
    if one.sensor is None:
        return None
    return Sensor(one.sensor.width_px, one.sensor.height_px, one.sensor.pixel_pitch_mm)


def running_series(plan: CameraPlan) -> RunningSeries | None:
    """Return the running adjustment of the camera's series; None if no parameter is shared."""
    calibrator = plan.calibrator
    if not isinstance(calibrator, Calibrator):
        return None
    from thermocald.analysis.online.running_series import RunningSeries

    running = RunningSeries(
        calibrator.sensor,
        calibrator.testfield,
        calibrator.settings,
        exterior=plan.calibration.exterior,
        offsets=plan.calibration.target_offsets,
    )
    return running if running.any else None


def _held(one: CameraConfig, calibration: CalibrationConfig) -> InteriorOrientation | None:
    """Return the start values, with fixed parameters at their values; None if none is fixed."""
    if not calibration.fixed:
        return None
    values: dict[str, float] = dict(calibration.fixed.items())
    if "c" not in values:
        if one.principal_distance_mm is None:
            raise ConfigurationError(
                f"camera {one.name!r}: `fixed` also needs principal_distance_mm, or c in `fixed`"
            )
        values["c"] = one.principal_distance_mm
    return InteriorOrientation(**values)


def series_head(
    plan: CameraPlan, frame: Frame, channels: Iterable[str]
) -> tuple[Head, TestField, dict[str, Any]]:
    """Return (head, test field, settings) of the series that begins with a frame."""
    extra: dict[str, Any] = dict(plan.extra)
    sensor = plan.sensor
    if sensor is None:
        # a placeholder: a series without calibration uses no sensor
        height, width = (1, 1) if frame.image is None else frame.image.shape
        sensor = Sensor(int(width), int(height), _UNKNOWN_PITCH_MM)
        extra["pixel_pitch_unknown"] = True
    spec = CameraSpec(plan.name, sensor, plan.config.principal_distance_mm, None)
    head = Head(
        name=f"{plan.name}-{plan.series}",
        series=plan.series,
        interval=plan.config.period_s,
        camera=spec,
        channels={name: Channel() for name in channels},
        extra=extra,
    )
    targets = plan.testfield or TestField.build([], np.empty((0, 3)))
    return head, targets, dict(plan.calibration.model_dump(mode="json"))


def check_series(plan: CameraPlan, series: StoredSeries, channels: Iterable[str]) -> None:
    """Raise ConfigurationError if a continued series would change its test field or channels.

    channels: those that the configuration names; their order does not matter.
    """
    mine = plan.testfield
    had = series.head.channels
    what = ""
    if mine is not None and not same_targets(mine, series.testfield):
        what = "test field"
    elif new := [name for name in channels if name not in had]:
        what = f"thermometers ({', '.join(had) or 'none'}, not {', '.join(new)})"
    if what:
        raise ConfigurationError(
            f"camera {plan.name!r}: choose a new name for its `series`, or configure the {what} "
            f"with which {plan.series!r} was begun"
        )


def heating_outputs(config: Config, what: str) -> list[int]:
    """Return the places of the outputs that heat; ConfigurationError about `what` if none does."""
    found = [i for i, o in enumerate(config.outputs) if load_driver("output", o.driver).heats]
    if not found:
        raise ConfigurationError(f"{what}: no output of the configuration heats")
    return found


def mock_config() -> Config:
    """Return the configuration of a simulated camera and thermometer."""
    store = {"path": "thermocald-mock.db"}
    return _rendered("mock", "housing", 1, store, Path("thermocald-mock-frames"))


def demo_config(folder: Path, seed: int) -> Config:
    """Return the configuration of the demo, with its store `demo.db` in a folder."""
    store = {"path": str(folder.absolute() / "demo.db"), "durable": False}
    return _rendered("demo", "temperature", seed, store, folder.absolute() / "frames")


def _rendered(
    name: str, thermometer: str, seed: int, store: Mapping[str, Any], frames: Path
) -> Config:
    camera = {
        "name": name, "driver": "mock", "principal_distance_mm": 3.04,
        "thermometers": [thermometer], "options": {"seed": seed},
    }  # fmt: skip
    document = {
        "store": store,
        "frames": {"keep": "none", "folder": str(frames), "min_free_gb": 0.1},
        "cameras": [camera],
        "thermometers": [{"name": thermometer, "driver": "mock", "options": {"seed": seed + 1}}],
    }
    return parse_config(document, Path("config.yaml"))


def recording_config(path: Path, store: Path | None = None) -> Config:
    """Return the configuration that plays a recording as camera and thermometer.

    What the store has already is not played into it twice; store: by default named after the
    recording. Raises RecordingError if nothing can be played.
    """
    recording = open_recording(path)
    head, name = recording.head, path.absolute().name
    camera, series = _name(head.camera.name), _name(head.series)
    place = store or Path(f"{name}.db")
    after = _played_until(place, camera, series)
    if after is not None and not (recording.columns.frame_time > after).any():
        raise RecordingError(
            f"{path}: the store has epochs of this series up to its last frame or later; choose "
            "another --store to play it again"
        )
    try:
        require_columns({"recorded": head.channels}, ConfigurationError)
    except ConfigurationError as error:
        raise RecordingError(f"{path}: cannot be played: {error}") from error
    sensor = head.camera.sensor
    replay = {
        "driver": "replay", "recording": str(path.absolute()), "after": after,
        "period_s": max(0.05, head.interval),
    }  # fmt: skip
    played = {
        "name": camera, "series": series, **replay,
        "sensor": {"width_px": sensor.width, "height_px": sensor.height,
                   "pixel_pitch_mm": sensor.pixel_pitch},
        "principal_distance_mm": head.camera.principal_distance,
        "testfield": str((path / "testfield.csv").absolute()),
        "thermometers": ["recorded"] if head.channels else [],
    }  # fmt: skip
    document = {
        "store": {"path": str(place), "durable": False},
        "frames": {"keep": "none", "folder": f"{name}-frames"},
        "cameras": [played],
        "thermometers": [{"name": "recorded", **replay}],
    }
    return parse_config(document, Path("config.yaml"))


def _played_until(path: Path, camera: str, series: str) -> float | None:
    """Return the time of a series' last epoch in a store, s UTC; None if there is none."""
    if not path.exists() or not path.stat().st_size:
        return None
    with Store.open(path) as store:
        found = store.series_of(camera, series)
        if found is None:
            return None
        times = store.series_columns(found, ["frame_time"])["frame_time"]
    return float(times.max()) if len(times) else None


def _name(text: str) -> str:
    """Convert a text to a valid name in a configuration."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", text).lstrip("_.-")[:64] or "camera"
