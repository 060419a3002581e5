"""Further functions of `import thermocald`: photographs, camera files, predictions, test fields.

Each does what a command does; units and errors are those of `thermocald.api`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.camera.camera import Camera, CameraDifference
from thermocald.analysis.thermal.predictions import read_model_log
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.api import Field, Paths, paths_of, read_testfield, thermal_of
from thermocald.errors import DataError, UsageError
from thermocald.names import checked
from thermocald.photogrammetry import camera_files
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, RASPBERRY_PI_V2
from thermocald.photogrammetry.field.testfield import Distance
from thermocald.series import (
    COLDEST_C,
    Progress,
    Say,
    Series,
    require_series,
    require_within,
    source_of,
)
from thermocald.series import open as open_series
from thermocald.store.logger.clock import device_clock
from thermocald.store.logger.options import LogOptions, log_options

if TYPE_CHECKING:
    from thermocald.analysis.thermal.places import Places
    from thermocald.analysis.thermal.predictions import Prediction
    from thermocald.analysis.thermal.scene import SceneCourse
    from thermocald.output.corrected import Correction
    from thermocald.photogrammetry.camera_files import Conversion
    from thermocald.photogrammetry.survey import Survey
    from thermocald.results import FieldCheck

Model = ThermalCamera | Path | str
LogRead = LogOptions | Mapping[str, Any] | None


def import_photographs(
    photographs: Paths,
    *,
    log: Path | str,
    testfield: Field | None = None,
    timezone: str | None = None,
    ambiguous: str = "refuse",
    camera_timezone: str | None = None,
    camera_clock: str = "0",
    log_options: LogRead = None,
    pixel_pitch: float | None = None,
    principal_distance: float | None = None,
    camera: Path | str | None = None,
    series: str = "M1",
    times: str = "exif",
    out: Path | str | None = None,
    say: Say = None,
) -> Series:
    """Make a series from photographs and a logger's temperatures (CSV in any dialect).

    testfield: without one, the series only shows how the files are interpreted. timezone: for times
    without one (`Europe/Berlin`, `+02:00`); such times are refused if it is not given; ambiguous:
    which of the two hours in autumn is meant. camera_timezone, camera_clock: the camera's own zone
    and the advance of its clock (`+00:03:12`). pixel_pitch, principal_distance (mm) or camera (a
    camera file): needed if EXIF does not give them. times: where a photograph's time is read,
    `exif`, `name` (file name) or `file` (file date). out: a new folder for the recording; if not
    given, the photographs are read in place. say: called with a line for each thing that was
    recognised and, with out, each that a calibration of some photographs shows to be doubtful.
    Raises DataError if times or columns cannot be understood, UsageError if a choice is needed.

    >>> photos = tc.import_photographs("photos", log="logger.csv", timezone="Europe/Berlin",
    ...                                testfield="M1/testfield.csv", pixel_pitch=0.00112)
    >>> len(photos)
    6
    """
    from thermocald.daemon.soundness import calibration_doubts
    from thermocald.store.logger.photographs import read_photographs, read_series, write_photographs
    from thermocald.store.recording.reader import read_recording
    from thermocald.store.recording.sense import doubt_lines

    if testfield is None and out is not None:
        raise UsageError("testfield is missing: without it no recording is written")
    require_within(pixel_pitch=(pixel_pitch, 1e-5, 1), principal_distance=(principal_distance, 0.1))
    tell, found = say or (lambda _: None), read_photographs(paths_of(photographs), times)
    recording, notes = read_series(
        found,
        device_clock(timezone, camera_timezone, camera_clock, ambiguous, "--camera-timezone"),
        source_of(log), _log_options(log_options or {"timezone": timezone}),
        testfield=None if testfield is None else read_testfield(testfield), series=series,
        camera=None if camera is None else source_of(camera), pitch=pixel_pitch,
        distance=principal_distance,
    )  # fmt: skip
    for note in notes:
        tell(note)
    if out is None:
        return Series(replace(recording, path=found[0].path.parent))  # its name in messages
    write_photographs(source_of(out), recording)
    if say is not None:  # whether the camera's data are plausible
        for doubt in doubt_lines(calibration_doubts(read_recording(source_of(out)))):
            say(doubt)
    return open_series(out)


def convert_camera(
    source: Path | str,
    out: Path | str,
    to: str,
    *,
    format: str | None = None,  # noqa: A002
    pixel_pitch: float | None = None,
) -> Conversion:
    """Convert a camera file, exactly if the formats' conventions allow it, else by a fit.

    The result states how well a fit agrees. to, format: the formats of out and of source, opencv,
    ros, colmap, mrcal, kalibr, metashape, aicon, json or yaml; the source's is by default
    recognised from its content. pixel_pitch: mm, needed if the file does not give it. Raises
    ConfigurationError, which names the file, UsageError for an unknown format.

    >>> print(tc.convert_camera("cold.json", "cold.xml", "metashape").statement)
    exact: both models give the same pixels
    """
    return camera_files.convert(source_of(source), source_of(out), to, format, pixel_pitch)


def compare_cameras(
    first: Path | str, second: Path | str, *, pixel_pitch: float | None = None
) -> CameraDifference:
    """Compare two camera files of any format: their parameters, and how far image points differ.

    pixel_pitch: mm, needed if the files do not give it. The result is second minus first, with
    standard deviations if both files have a covariance. Raises ConfigurationError if the cameras'
    image sizes differ.

    >>> found = tc.compare_cameras("cold.json", "warm.json")
    >>> found.rms_px > 0, found.has_sd
    (True, True)
    """
    a, b = (camera_files.read(source_of(p), pixel_pitch=pixel_pitch) for p in (first, second))
    names = str(first), str(second)
    return CameraDifference(names, a.model, b.model, (a.covariance, b.covariance))


def predict(
    model: Model,
    temperature: float | None = None,
    *,
    channels: Mapping[str, float] | None = None,
    log: Path | str | None = None,
    log_options: LogRead = None,
    test: Sequence[Series] = (),
    programme: Path | str | None = None,
    camera: Path | str | None = None,
    distance_m: float = 10.0,
    wanted_mm: float = 5.0,
    extrapolate: bool = False,
    progress: Progress = None,
) -> Prediction:
    """Predict a camera at a temperature (°C), along a log, for series, or during a programme.

    channels: {name: °C} of the other thermometers. log: a logger's file, a recording or a store;
    log_options: how to read it. test: measured series with which the prediction is compared.
    programme: a heating programme, and camera: the YAML file that describes how the camera warms;
    the result tells when the camera is steady to wanted_mm at distance_m. Raises UsageError unless
    exactly one of temperature, log, test and programme is given, and far outside the model's range
    unless `extrapolate` is set.

    >>> tc.predict("camera.yaml", 35.0).document["temperature"]
    35.0
    """
    from thermocald.analysis.thermal import predictions

    test = list(test)
    if sum((temperature is not None, log is not None, bool(test), programme is not None)) != 1:
        raise UsageError("give one of --temperature, --log, --test, --programme")
    if channels is not None and temperature is None:
        raise UsageError("channels belong to a temperature; a log has its own")
    if camera is not None and programme is None:
        raise UsageError("camera describes how it warms: give a programme too")
    require_within(
        temperature=(temperature, COLDEST_C), distance_m=(distance_m, 0.01),
        wanted_mm=(wanted_mm, 1e-3),
    )  # fmt: skip
    require_series(test)
    thermal = thermal_of(model)
    if temperature is not None:
        state = thermal.at(temperature, channels=channels, extrapolate=extrapolate)
        return predictions.describe_camera(thermal, state, distance_m)
    if log is not None:
        table = read_model_log(thermal, source_of(log), _log_options(log_options))
        return predictions.predict_along(thermal, table, extrapolate)
    if test:
        inputs = [one.observed(progress) for one in test]
        return predictions.check_prediction(thermal, inputs)
    assert programme is not None
    device = None if camera is None else source_of(camera)
    return predictions.advise_warm_up(thermal, source_of(programme), device, distance_m, wanted_mm)


def correct(
    points: Path | str,
    model: Model,
    *,
    log: Path | str,
    log_options: LogRead = None,
    to: float | None = None,
    temperature_sd: float | None = None,
    size: tuple[int, int] | None = None,
    timezone: str | None = None,
    ambiguous: str = "order",
    extrapolate: bool = False,
    say: Say = None,
) -> Correction:
    """Correct image points or images for the camera's temperature when they were taken.

    points: a CSV with time, x, y (px), or time, image; `-` reads standard input. log: a
    logger's file, a recording or a store. to: the temperature to correct to, °C, by default the
    model's T0. temperature_sd: of a reading, K, by default as the fit estimated it. size: width and
    height of binned images, px. timezone, ambiguous: for times without a zone. say: called with a
    line for each row that cannot be corrected. The correction is computed when the result is
    written. Raises DataError for a table that cannot be read.

    >>> done = tc.correct("points.csv", "camera.yaml", log="M1")
    >>> done.write("corrected.csv")
    >>> done.points
    2
    """
    from thermocald.analysis.thermal.correction import first_times
    from thermocald.output.corrected import Correction

    require_within(to=(to, COLDEST_C), temperature_sd=(temperature_sd, 0.0))
    thermal, path = thermal_of(model), source_of(points)
    if size is not None:
        thermal = thermal.for_images(*size)
    clock = device_clock(timezone, ambiguous=ambiguous)
    options = _log_options(log_options)
    header, near = first_times(path, clock, options.date_order)
    table = read_model_log(thermal, source_of(log), options, near)
    if temperature_sd is None:
        temperature_sd = thermal.reading_sd
    of_images = "image" in header and "x" not in header
    return Correction(
        path, of_images, thermal, table, clock, to, temperature_sd, extrapolate,
        say or (lambda _: None), options.date_order,
    )  # fmt: skip


def measure(
    points: Path | str,
    model: Model,
    *,
    log: Path | str,
    control: Path | str,
    seen: str,
    surface: Path | str,
    unit: str = "mm",
    log_options: LogRead = None,
    timezone: str | None = None,
    ambiguous: str = "order",
    extrapolate: bool = False,
    say: Say = None,
) -> Places:
    """Measure image points on a water surface, a plane, a staff or a cross-section.

    points: a CSV with time, x, y, sx, sy (px) and name. log: a logger's file, a recording or a
    store. control: control points (CSV, GeoJSON, pyorc's JSON) with their image coordinates at the
    time `seen`. surface: a YAML file with level, plane, line or profile, in the unit (mm or m) and
    coordinate system of the control points. timezone, ambiguous: for times without a zone. say:
    called with a line for each row that is left out. Raises DataError if there is no pose or no
    temperature, ConfigurationError, which names the file, GeometryError for rays that miss the
    surface.

    >>> tc.measure("points.csv", "camera.yaml", log="M1", control="gcp.csv", seen="0",
    ...            surface="water.yaml", unit="km")
    Traceback (most recent call last):
    thermocald.errors.UsageError: --length-unit km: must be mm or m
    """
    from thermocald.analysis.thermal.control_points import UNITS, ControlPoints
    from thermocald.analysis.thermal.correction import first_times, row_blocks, seconds_of
    from thermocald.analysis.thermal.places import measure_places, read_surface

    if unit not in UNITS:
        raise UsageError(f"--length-unit {unit}: must be mm or m")
    tell = say or (lambda _: None)
    thermal, path = thermal_of(model), source_of(points)
    clock = device_clock(timezone, ambiguous=ambiguous)
    controls = ControlPoints.read(source_of(control), unit)
    if controls.assumed:
        tell(controls.assumed)
    plane = read_surface(source_of(surface), controls)
    options = _log_options(log_options)
    order = options.date_order
    _, near = first_times(path, clock, order)
    table = read_model_log(thermal, source_of(log), options, near)
    rows = list(row_blocks(path, ("x", "y", "sx", "sy"), clock, order, table))
    unknown = "its temperature is not known: outside the log, or in a gap of over ten intervals"
    known = [block.kept(table.known_at(block.times), unknown) for block in rows]
    if any(block.lines for block in known):  # without any, the error tells the log's span
        rows = known
    for line, why in (refused for block in rows for refused in block.refused):
        tell(f"{path}, line {line}: {why}; left out")
    when = seconds_of(seen, clock, order, table)
    if not table.known_at(np.array([when])).all():
        raise DataError(f"--seen {seen}: the log {log} has no temperature at that time")
    return measure_places(thermal, table, controls, when, plane, rows, extrapolate)


def follow_scene(
    photographs: Path | str,
    model: Model,
    *,
    log: Path | str,
    log_options: LogRead = None,
    times: str = "exif",
    timezone: str | None = None,
    progress: Progress = None,
    recording: Path | str | None = None,
) -> SceneCourse:
    """Compare the image motion of static points in a scene with the thermal model's prediction.

    photographs: a folder; the first is the reference. log: a logger's file, a recording or a store.
    times: where a photograph's time is read, `exif`, `name` (file name) or `file` (file date).
    timezone: for times without one. recording: a folder in which the static points are recorded,
    for `open` and `discover`. Raises DataError if there is no temperature or no point to follow.

    >>> tc.follow_scene("photos", "camera.yaml", log="logger.csv", times="sun")
    Traceback (most recent call last):
    thermocald.errors.UsageError: --times sun: must be one of exif, name, file
    """
    from thermocald.analysis.thermal import scene
    from thermocald.store.logger.photographs import read_photographs

    thermal = thermal_of(model)
    pictures = read_photographs([source_of(photographs)], times)
    moments = [picture.moment for picture in pictures]
    taken = device_clock(timezone).utc(moments, lambda i: str(pictures[i].path)).tolist()
    options = _log_options(log_options or {"timezone": timezone})
    table = read_model_log(thermal, source_of(log), options, (min(taken), max(taken)))
    frames = list(zip([picture.path for picture in pictures], taken, strict=True))
    folder = None if recording is None else Path(recording)
    return scene.follow_scene(
        thermal, table, frames, advance=progress or (lambda _: None), recording=folder
    )


def fit_calibrations(
    calibrations: Mapping[str, float | None],
    *,
    log: Path | str | None = None,
    log_options: LogRead = None,
    timezone: str | None = None,
    ambiguous: str = "order",
    T0: float | None = None,
    temperature_sd: float = 0.1,
    say: Say = None,
) -> ThermalCamera:
    """Fit a thermal model to calibrations from photographs at two or more temperatures.

    calibrations: {file: °C}, JSON files written by `calibrate`. log: a thermometer's log, which
    gives the temperatures at the photographs' times in place of the °C; timezone, ambiguous: for
    these times. T0: reference temperature, °C, by default the mean. temperature_sd: of each
    temperature, K. say: called with notes about the log. Raises UsageError if a temperature is
    missing or the cameras differ, DataError if the temperature range is too narrow.

    >>> tc.fit_calibrations({"cold.json": 26.0, "warm.json": 45.0}).model.T0
    35.5
    """
    from thermocald.analysis.thermal import calibrations as calibrated
    from thermocald.store.logger.temperatures import read_log

    if not calibrations:
        raise UsageError("give at least two calibrations to fit a model to")
    require_within(T0=(T0, COLDEST_C), temperature_sd=(temperature_sd, 0.0))
    for name in calibrations:
        if not calibrated.is_calibration(source_of(name)):
            raise UsageError(
                f"{name}: is not a calibration; fit series and calibrations separately"
            )
    given = [calibrated.read_calibration(source_of(name), T) for name, T in calibrations.items()]
    channel = "temperature"
    if log is not None:
        clock = device_clock(timezone, ambiguous=ambiguous)
        spans = [c.span(clock) for c in given]
        near = float(min(s.min() for s in spans)), float(max(s.max() for s in spans))
        table = read_log(source_of(log), _log_options(log_options), near)
        channel = next(iter(table.channels))
        for note in table.notes:
            (say or (lambda _: None))(note)
        given = [calibrated.with_log(c, table, clock) for c in given]
    return calibrated.fit_calibrations(given, T0, temperature_sd, channel)


def survey_testfield(
    photographs: Paths,
    *,
    scale: tuple[str, str, float] | None = None,
    scale_sd: float = 0.1,
    distances: Path | str | None = None,
    field: Field | None = None,
    camera: Path | str | None = None,
    hold_camera: bool = False,
    pixel_pitch: float | None = None,
    out: Path | str | None = None,
    camera_out: Path | str | None = None,
    say: Say = None,
) -> Survey:
    """Measure a test field's coordinates and their standard deviations from photographs of it.

    photographs: files or folders, from one camera. scale: two targets and their distance, mm, with
    scale_sd, mm. distances: further distances, a CSV (a, b, length, sigma in mm). field: the field
    as printed, needed for plain circles. camera: a camera file of any format; hold_camera: do not
    estimate its parameters. pixel_pitch: mm, by default the camera file's, else 0.001. out,
    camera_out: files to write, the testfield.csv and the camera (JSON). say: called with a line at
    each step. Raises UsageError if the scale is missing, GeometryError if the photographs do not
    support the adjustment. Source: bundle adjustment, Luhmann et al. 2019, chapter 4.4.

    >>> tc.survey_testfield(["photos"], field="M1/testfield.csv")
    Traceback (most recent call last):
    thermocald.errors.UsageError: the scale is missing: --scale A B MM, or --distances FILE
    """
    from thermocald.analysis.camera.photographs import images_of
    from thermocald.photogrammetry.survey import survey
    from thermocald.photogrammetry.targets.image_file import decode_grey
    from thermocald.store.logger.photographs import find_copies
    from thermocald.store.recording.testfield_file import read_distances, write_testfield

    require_within(pixel_pitch=(pixel_pitch, 1e-5, 1))
    measured = [] if scale is None else [Distance(*scale, scale_sd)]
    if distances is not None:
        measured += read_distances(source_of(distances))
    if not measured:
        raise UsageError("the scale is missing: --scale A B MM, or --distances FILE")
    for d in measured:
        if not (d.length > 0 and d.sigma > 0) or d.a == d.b:
            raise UsageError(f"{d.a} to {d.b}, {d.length:g} ± {d.sigma:g} mm, is not a distance")
    if hold_camera and camera is None:
        raise UsageError("--hold-camera needs --camera")
    paths = images_of(paths_of(photographs))
    tell = say or (lambda _: None)
    copies = find_copies(paths)
    for copy, first in copies.items():
        tell(f"{paths[copy]}: is a copy of {paths[first].name}, left out")
    known = None
    if camera is not None:
        known = camera_files.read(source_of(camera), pixel_pitch=pixel_pitch).model
        pixel_pitch = known.sensor.pixel_pitch
    if pixel_pitch is None:
        pixel_pitch = 0.001
        tell("pixel pitch not given: 0.001 mm assumed; the camera's mm depend on it")
    found = survey(
        {str(path): partial(decode_grey, path) for k, path in enumerate(paths) if k not in copies},
        measured,
        pixel_pitch,
        nominal=None if field is None else read_testfield(field),
        interior=None if known is None else known.interior,
        free=() if hold_camera else IOP_NAMES,
        progress=tell,
    )
    if out is not None:
        write_testfield(source_of(out), found.field)
    if camera_out is not None:
        n, name = found.network, "the survey" if out is None else f"the survey of {Path(out).name}"
        comment = f"self-calibration in {name}, sigma0 {n.sigma0:.2f}"
        target = source_of(camera_out)
        camera_files.write(n.camera, target, "json", n.interior_covariance, comment)
    return found


def check_testfield(
    field: Field,
    *,
    camera: Camera | Path | str | None = None,
    pixel_pitch: float | None = None,
    place: tuple[float, float, float] | None = None,
    look_at: tuple[float, float, float] | None = None,
    roll: float = 0.0,
    sigma_px: float = 0.03,
) -> FieldCheck:
    """Assess a test field: how well a camera sees it, what it would calibrate, what is missing.

    camera: a camera file of any format, by default a Raspberry Pi camera v2.1. pixel_pitch: mm,
    needed if the file does not give it. place: the camera's X, Y, Z, mm, by default where the field
    just fills its image. look_at: X, Y, Z, mm, by default the field's centre. roll: degrees.
    sigma_px: standard deviation of an image coordinate. Raises ConfigurationError for a camera file
    that cannot be read.

    >>> tc.check_testfield("M1/testfield.csv").as_dict()["calibrates"]
    True
    """
    from thermocald.analysis.field import assess_field
    from thermocald.results import FieldCheck

    require_within(sigma_px=(sigma_px, 1e-4))
    for name, value in (("place", place), ("look_at", look_at), ("roll", roll)):
        if value is not None and not np.isfinite(value).all():
            raise UsageError(f"{name} is {value}; it must be finite")
    if camera is None:
        model = RASPBERRY_PI_V2
    elif isinstance(camera, Camera):
        model = camera.model
    else:
        model = camera_files.read(source_of(camera), pixel_pitch=pixel_pitch).model
    found = assess_field(read_testfield(field), model, place, look_at, roll, sigma_px)
    return FieldCheck(**vars(found))


def _log_options(given: LogRead) -> LogOptions:
    if isinstance(given, LogOptions):
        return given
    known, options = signature(log_options).parameters, dict(given or {})
    for name, value in options.items():
        if name not in known:
            raise UsageError(f"log_options: there is no {name!r}; there are: {', '.join(known)}")
        if name in ("name", "temperature_column", "time_column") and isinstance(value, str):
            options[name] = [value]
    return checked(log_options)(**options)
