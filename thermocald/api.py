"""The functions that `import thermocald` offers; each does what the command of its name does.

Times are seconds since 1970-01-01 UTC or datetime64, temperatures °C, lengths mm, image points px.
Wrong input raises the errors of `thermocald.errors`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.analysis.thermal.thermal_camera import ThermalCamera, load_camera
from thermocald.errors import UsageError
from thermocald.names import file_name
from thermocald.photogrammetry.camera.camera_model import DEFAULT_FREE
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.physics.model import ThermalModel
from thermocald.series import (
    COLDEST_C,
    Progress,
    Say,
    Series,
    free_names,
    require_series,
    require_within,
    source_of,
)
from thermocald.series import open as open_series

if TYPE_CHECKING:
    from thermocald.analysis.study.measured import StudySettings
    from thermocald.discovery.plan import Plan
    from thermocald.physics.model import ModelEffect
    from thermocald.physics.presets import Catalogue
    from thermocald.results import Calibration, Discovery, Study
    from thermocald.thermal.series import ReducedSeries

Paths = Path | str | Sequence[Path | str]
Field = TestField | Path | str
Model = ThermalCamera | ThermalModel | Path | str
Effects = Mapping[str, Mapping[str, Any]] | Iterable[str | Path] | Path | str


def read_testfield(source: Field) -> TestField:
    """Read a testfield.csv: the targets' names, coordinates and standard deviations, mm.

    Raises TestFieldError, which names the line and the column.

    >>> field = tc.read_testfield("M1/testfield.csv")
    >>> len(field), field.points.shape
    (147, (147, 3))
    """
    from thermocald.store.recording.testfield_file import read_testfield as read

    return source if isinstance(source, TestField) else read(source_of(source))


def calibrate(
    images: Paths,
    testfield: Field,
    *,
    camera: Path | str | None = None,
    pixel_pitch: float | None = None,
    free: str | Iterable[str] = DEFAULT_FREE,
    progress: Progress = None,
) -> Calibration:
    """Calibrate a camera from photographs of a test field that share one interior orientation.

    images: files or folders. camera: a camera file of any format with initial values, which are
    held if the photographs do not support a calibration. pixel_pitch: mm; 1 µm is assumed if
    neither it nor a camera is given. free: the parameters of the interior orientation to estimate.
    progress: called with the number of further photographs measured. Raises UsageError if there is
    no photograph; the result reports the status of each. Source: bundle adjustment with data
    snooping, Luhmann et al. 2019, chapter 4.4.

    >>> one = tc.calibrate("board", "board.csv", pixel_pitch=0.003)
    >>> one.status, len(one.poses)
    ('ok', 8)
    """
    from thermocald.analysis.camera.photographs import (
        calibrate_photographs,
        images_of,
        unknown_camera,
    )
    from thermocald.photogrammetry.camera_files import read_camera
    from thermocald.results import Calibration

    require_within(pixel_pitch=(pixel_pitch, 1e-5, 1))
    paths = images_of(paths_of(images))
    if camera is not None:
        file = read_camera(source_of(camera), pixel_pitch)
    else:
        file = unknown_camera(paths, pixel_pitch)
    settings = AdjustmentSettings(free=free_names(free))
    field = read_testfield(testfield)
    photographs = vars(calibrate_photographs(paths, field, file, settings, progress))
    assumed = camera is None and pixel_pitch is None
    return Calibration(**photographs, file=file, pitch_assumed=assumed)


def study(
    *series: Series,
    labels: Sequence[str | None] = (),
    window: int = 31,
    alpha: float = 0.05,
    sets: int = 50_000,
    seed: int = 0,
    distance_mm: float = 10_000.0,
    grid: int = 3,
    focus_mm: float = 1000.0,
    f_number: float = 2.0,
    confusion_mm: float | None = None,
    thermometer_sd: float | None = None,
    exterior: str = "auto",
    free: str | Iterable[str] = DEFAULT_FREE,
    jobs: int = 1,
    progress: Progress = None,
) -> Study:
    """Study a camera's changes with temperature, their significance, and their effect on objects.

    labels: one per series, by default the camera's name; series with the same label are one camera.
    window (epochs), alpha: width and level of the F-test. sets, seed: of the Monte-Carlo
    simulation, on a plane at distance_mm with grid × grid points. focus_mm, f_number, confusion_mm:
    of the depth of field. thermometer_sd: K, estimated if not given. exterior, free: as in
    `Series.calibrate`. jobs: number of processes. progress: called with the number of further sets
    drawn. Raises UsageError if a series is given twice, DataError if none can be studied. Source:
    Elias et al. 2020, Sensors 20, 643, section 4.

    >>> found = tc.study(tc.open("M1"), tc.open("M2"), sets=200)
    >>> found.cameras[0].label
    'rpi-v2.1'
    """
    from thermocald.analysis.study.study import study as run
    from thermocald.results import Study
    from thermocald.thermal.source import refuse_copies

    if not series:
        raise UsageError("give at least one series to study")
    if len(labels) > len(series):
        raise UsageError(
            f"{len(labels)} labels for {len(series)} series; give one for each at most"
        )
    require_series(series)
    settings = _study_settings(
        window=window, alpha=alpha, sets=sets, seed=seed, distance_mm=distance_mm, grid=grid,
        focus_mm=focus_mm, f_number=f_number, confusion_mm=confusion_mm,
        thermometer_sd=thermometer_sd, jobs=jobs,
    )  # fmt: skip
    measured = [
        one.measured(label, thermometer_sd, exterior, free_names(free), jobs)
        for label, one in zip_longest(labels, series)
    ]
    several = [(one.source, one.values) for one in measured if len(one) > 1]
    refuse_copies(several, "has the same epochs as {}; give each series once", 1e-9, 0.0)
    return Study(settings, run(measured, settings, progress).cameras)


def reference_study(*, progress: Progress = None, **settings: Any) -> Study:
    """Study the presets and compare each number with the one that the reference study published.

    settings: those of `study`, from window to jobs. progress: called with the number of further
    series done. Source: Elias et al. 2020, Sensors 20, 643, section 4.
    """
    from thermocald.analysis.study.reference import compare, reference_studies
    from thermocald.results import Study

    chosen = _study_settings(**settings)
    cameras = tuple(reference_studies(chosen, progress or (lambda _: None)))
    return Study(chosen, cameras, tuple(c for camera in cameras for c in compare(camera)))


def fit(
    *series: Series,
    effects: Effects = (),
    model: Model | None = None,
    T0: float | None = None,
    kind: str | Path | ThermalModel | None = None,
    jobs: int = 1,
    progress: Progress = None,
) -> ThermalCamera:
    """Fit a thermal model to the series of a camera, in one adjustment of all image points.

    effects: names, as for `--effect`, or {name: {parameter: start value}}. model: a model whose
    effects and T0 are fitted again, for example discovery's. T0: reference temperature, °C, by
    default the mean. kind: a name, to fit the model of a camera type to the series of several
    cameras; or such a type's model, to support a camera that was measured at few temperatures.
    jobs: number of processes. progress: called with the number of further frames measured. Raises
    DataError for series of different cameras or at a single temperature, UsageError for a series
    given twice or an effect that a series cannot show.

    >>> camera = tc.fit(tc.open("M1"), tc.open("M2"))
    >>> camera.model.camera
    'rpi-v2.1'
    """
    from thermocald.analysis.thermal.thermal_model import (
        fit_camera,
        fit_type,
        fit_with_type,
        require_type,
    )
    from thermocald.physics.model_file import read_model
    from thermocald.thermal.hypothesis import check_names
    from thermocald.thermal.reduce import reduce_series
    from thermocald.thermal.source import refuse_copies

    if not series:
        raise UsageError("give at least one series to fit a model to")
    require_series(series)
    require_within(T0=(T0, COLDEST_C), jobs=(jobs, 1, 256))
    if isinstance(kind, str | Path) and _is_file(kind):
        kind = read_model(source_of(kind))
    if isinstance(kind, ThermalModel):
        require_type(kind)
        if effects or model is not None or T0 is not None:
            raise UsageError(f"type {kind.camera}: effects and T0 are the type's; give no others")
    start = _model_of(model)
    listed = [] if start is None else list(start.effects)
    for effect in _effects(effects):
        if any(e.name == effect.name for e in listed):
            raise UsageError(f"effect {effect.name} is given twice")
        listed.append(effect)
    T0 = start.T0 if start is not None and T0 is None else T0
    inputs = [one.observed(progress, jobs) for one in series]
    refuse_copies([(one.name, one.grid.points) for one in inputs])
    reduced = [reduce_series(one, strict=False) for one in inputs]
    check_names(listed, reduced)
    if isinstance(kind, ThermalModel):
        camera = fit_with_type(reduced, kind)
    elif kind is not None:
        camera = fit_type(reduced, listed, T0, str(kind))
    else:
        camera = fit_camera(reduced, listed, T0)
    return replace(camera, fitted={**(camera.fitted or {}), "doubts": _doubts(series, reduced)})


def discover(
    series: Series,
    *,
    verify: Sequence[Series] = (),
    model: Model | None = None,
    jobs: int = 1,
    say: Say = None,
) -> Discovery:
    """Find where simulation and measurement disagree, and name and verify the missing effect.

    verify: further series of the camera, measured at another time, on which an effect is verified.
    model: the model to start from, by default the base model, linear in temperature. jobs: number
    of processes. say: called with a line at each step. Raises DataError for series of different
    cameras or thermometers and for copies, UsageError if the series is also given in verify.

    >>> found = tc.discover(tc.open("M1"), verify=[tc.open("M2")])
    >>> found.verdict
    'effects_found'
    """
    from thermocald.discovery.evidence import require_other_series
    from thermocald.discovery.result import discover_series
    from thermocald.results import Discovery
    from thermocald.thermal.reduce import reduce_together

    require_within(jobs=(jobs, 1, 256))
    tell = say or (lambda _: None)
    every = (series, *verify)
    require_series(every)
    start = _model_of(model)
    inputs = []
    for one in every:
        tell(f"reading {one.source}")
        inputs.append(one.observed(None, jobs, say=say))
    require_other_series(inputs)
    tell("reducing the epochs to normal equations")
    evidence = reduce_together(inputs, None if start is None else start.T0)
    found = discover_series(evidence, say, () if start is None else start.effects, jobs)
    values = vars(found) | {"doubts": tuple(_doubts(every, evidence))}
    return Discovery(**values, name=series.source.rsplit("/", 1)[-1], before=start)


def plan(
    series: Series | None = None,
    *,
    preset: str | None = None,
    model: Path | str | None = None,
    testfield: Path | str | None = None,
    programme: Path | str | None = None,
    strength_px: float = 0.1,
    seeds: int = 2,
    progress: Progress = None,
) -> Plan:
    """Predict which effects a set-up could reveal, before the camera is heated.

    The set-up is a series (its epochs and noise), a preset of `simulate`, or a model and a
    programme. testfield: a testfield.csv, or markers, circles, plain. strength_px: RMS of each
    effect in the image. seeds: number of repetitions. progress: called with the number of further
    effects done. Raises UsageError if no set-up is given.

    >>> tc.plan(model="camera.yaml")
    Traceback (most recent call last):
    thermocald.errors.UsageError: --plan needs a recording of the set-up, or --preset, or ...
    """
    from thermocald.discovery.plan import plan_power, set_ups

    require_within(strength_px=(strength_px, 0.001), seeds=(seeds, 1))
    idle = [model] if preset is not None else []
    if series is not None:
        idle = [preset, model, testfield, programme]
    if any(one is not None for one in idle):
        raise UsageError(
            "give one set-up: a series; or a preset or a model, with a testfield and a programme"
        )
    thermal, course = (None if p is None else source_of(p) for p in (model, programme))
    source = None if series is None else series.observed()
    field = None if testfield is None else str(source_of(testfield))
    inputs = set_ups(source, thermal, preset, field, course, seeds)
    return plan_power(inputs, strength_px, progress or (lambda _: None))


def catalogue() -> Catalogue:
    """List the presets of `simulate` and the effects that a camera can have.

    >>> next(iter(tc.catalogue().as_dict()["presets"])).get("preset")
    'nexus5-cold'
    """
    from thermocald.physics.presets import Catalogue

    return Catalogue()


def simulate(
    preset: str | None = None,
    *,
    model: Path | str | None = None,
    camera: Path | str | None = None,
    programme: Path | str | None = None,
    effects: Effects = (),
    own_effects: bool = True,
    lamp: Sequence[tuple[float, float]] | None = None,
    seed: int = 0,
    series: str = "M1",
    testfield: Field | None = None,
    epochs: int | None = None,
    frames: bool = False,
    out: Path | str | None = None,
    model_out: Path | str | None = None,
    progress: Progress = None,
) -> Series:
    """Simulate a series of a camera that warms up.

    preset: a camera of the reference study (`rpi-v2.1-heating`, `nexus5-cold`, …). model, camera,
    programme: YAML files that replace the preset's thermal model; its heat flow, thermometers and
    noise; and its heating programme. effects: to add, {name: {parameter: value}},
    or effect files and texts as for `--effect`. own_effects: whether the preset's own effects stay.
    lamp: [(from s, W)], heats the housing in place of the programme's sources. testfield: a file,
    or markers, circles, plain; by default a corner of 147 circles. epochs: by default the preset's
    150. frames: render frames, not points. out: the recording's folder; by default a temporary one,
    removed when the program ends. model_out: a file for the simulated model. The series has its
    `truth` and `simulation`. Raises ConfigurationError for an unknown preset or effect, UsageError
    if neither a preset nor a model with a programme is given, or an effect has no size.

    >>> simulated = tc.simulate("rpi-v2.1-heating", effects={"thermal_lag": {"tau": 75}}, seed=1)
    >>> len(simulated)
    150
    """
    import atexit
    import shutil
    import tempfile

    from thermocald.physics import catalogue as known
    from thermocald.physics.heat import Course
    from thermocald.physics.model_file import write_model
    from thermocald.physics.presets import given_simulation
    from thermocald.physics.testfields import load_field

    require_within(seed=(seed, 0), epochs=(epochs, 1))
    file_name(series, "series", UsageError)
    steps = [] if lamp is None else [(float(t), float(watts)) for t, watts in lamp]
    begins = [t for t, _ in steps]
    finite = all(math.isfinite(v) for pair in steps for v in pair)
    if lamp is not None and not (steps and finite and begins == sorted({*begins})):
        raise UsageError(f"lamp is {steps}; give finite (from s, W) in the order of time")
    thermal, device, course_file = (
        None if p is None else source_of(p) for p in (model, camera, programme)
    )
    if testfield is not None and not isinstance(testfield, TestField):
        testfield = load_field(str(source_of(testfield)))
    simulation = given_simulation(preset, thermal, device, testfield, course_file, seed, series)
    simulated = simulation.model if own_effects else replace(simulation.model, effects=())
    for effect in _effects(effects):
        kind = known.get(effect.name)
        if kind.linear and not any(effect.values.get(key) for key in kind.linear):
            key = next(k for k in kind.linear if k in effect.values)
            raise UsageError(
                f"effect {effect.name} has no size and would change nothing; give {key} "
                f"in {kind.linear[key]}: {effect.name}:{key}=…"
            )
        simulated = simulated.with_effect(effect)
    course = simulation.programme
    if epochs is not None:
        course = replace(course, epochs=epochs)
    if steps:
        lit = Course.steps([*begins, begins[-1] + 1e9], [watts for _, watts in steps])
        course = replace(course, sources={"housing": lit})
    simulation = replace(simulation, model=simulated, programme=course)
    if out is None:
        folder = Path(tempfile.mkdtemp(prefix="thermocald-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        out = folder / series
    simulation.write(source_of(out), with_frames=frames, advance=progress or (lambda _: None))
    if model_out is not None:
        write_model(source_of(model_out), replace(simulated, exterior=simulation.exterior))
    made = open_series(out)
    made.simulation = simulation
    return made


def _study_settings(**given: Any) -> StudySettings:
    from thermocald.analysis.study.measured import StudySettings

    s = StudySettings(**given)
    require_within(
        window=(s.window, 3), alpha=(s.alpha, 1e-6, 0.5), sets=(s.sets, 2), seed=(s.seed, 0),
        distance_mm=(s.distance_mm, 10.0), grid=(s.grid, 2, 9), focus_mm=(s.focus_mm, 10.0),
        f_number=(s.f_number, 0.1), confusion_mm=(s.confusion_mm, 1e-6),
        thermometer_sd=(s.thermometer_sd, 0.0), jobs=(s.jobs, 1, 256),
    )  # fmt: skip
    if s.window % 2 == 0:
        raise UsageError(f"--window is {s.window}; it must be odd, so that it has a centre")
    return s


def _doubts(series: Sequence[Series], reduced: Sequence[ReducedSeries]) -> list[str]:
    """Return what is doubtful in the series, each with its source if there are several."""
    from thermocald.thermal.reduce import mean_misclosure

    return [
        text if len(series) == 1 else f"{one.source}: {text}"
        for one, r in zip(series, reduced, strict=True)
        for text in one.doubts(interior=r.at.iop, offsets=mean_misclosure(r.source, r.at))
    ]


def paths_of(given: Paths) -> list[Path]:
    """Return the paths of files and folders, with `~` expanded."""
    return [source_of(p) for p in ((given,) if isinstance(given, str | Path) else given)]


def _model_of(model: Model | None) -> ThermalModel | None:
    if model is None or isinstance(model, ThermalModel):
        return model
    return thermal_of(model).model


def thermal_of(model: ThermalCamera | Path | str) -> ThermalCamera:
    """Return a thermal camera, loaded if it is given by its file."""
    return model if isinstance(model, ThermalCamera) else load_camera(model)


def _is_file(given: Path | str) -> bool:
    return isinstance(given, Path) or Path(given).suffix in (".yaml", ".yml")


def _effects(given: Effects) -> list[ModelEffect]:
    from thermocald.physics.model_file import read_effects
    from thermocald.thermal.hypothesis import effect_with, parse_effect

    if isinstance(given, Mapping):
        return [effect_with(name, values) for name, values in given.items()]
    found: list[ModelEffect] = []
    for one in (given,) if isinstance(given, str | Path) else given:
        found += read_effects(source_of(one)) if _is_file(one) else [parse_effect(str(one))]
    return found
