"""Audit of the thermal model: `fit`, `predict`, `correct`, and the model that `discover` writes."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.audit_camera import CAMERAS, DEPTHS, Scene
from benchmarks.audit_rows import Row, ratio, share
from thermocald.analysis.thermal.correction import correct_points
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.discovery.result import build_model, discover_series
from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.physics.heat import Course
from thermocald.physics.model import ModelEffect, follow_angle
from thermocald.physics.presets import preset_simulation
from thermocald.store.logger.temperatures import TemperatureLog
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.source import epochs_input

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.thermal.series import SeriesInput

    Array = NDArray[np.float64]

NAMES = ("c", "x0", "y0")
TAU = 70.0
LAG = ModelEffect("thermal_lag", {"tau": TAU})
FIELD_MM = 0.02
NEAR = 35.0  # °C, for `predict`


def simulated(
    seed: int, effects: tuple[ModelEffect, ...] = (LAG,), epochs: int = 120, power: float = 9.0,
    until: float = 500.0, series: str = "M1", begin: float = 80.0,
) -> Any:  # fmt: skip
    """Return a simulation with these effects, heated from `begin` to `until` s."""
    s = preset_simulation("rpi-v2.1-heating", seed=seed, series=series)
    lamp = Course.steps([0, begin, until, 1e5], [0.0, power, 0.0])
    programme = replace(s.programme, epochs=epochs, sources={"housing": lamp})
    return replace(s, model=replace(s.model, effects=effects), programme=programme)


def seen(s: Any, rng: np.random.Generator | None = None) -> SeriesInput:
    """Return the recorded series; with `rng`, the field's coordinates have errors of 0.02 mm."""
    field = s.field
    if rng is not None:
        points = field.points + rng.normal(0, FIELD_MM, field.points.shape)
        field = replace(field, points=points, sigmas=np.full(points.shape, FIELD_MM))
    return epochs_input(s.head, field, list(s.epochs()), s.programme.series)


def fitted(source: SeriesInput, *effects: ModelEffect) -> ThermalCamera:
    """Return the model fitted to the series, which is reduced as `fit` does it."""
    return fit_thermal_model([reduce_series(source, strict=False)], effects)


def before(scene: Scene, s: Any) -> SeriesInput:
    """Return the series of another camera, heated alike before its field, without C1 and C2."""
    model = replace(
        s.model, sensor=scene.sensor, interior=InteriorOrientation.from_array(scene.iop),
        exterior=ExteriorOrientation.from_array(scene.eop),
    )  # fmt: skip
    device, true = replace(s.device, sensor=scene.sensor), replace(scene.field, points=scene.points)
    source = seen(replace(s, model=model, device=device, field=true))
    return replace(source, field=scene.field, interior=replace(model.interior, C1=0.0, C2=0.0))


def other_cameras(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit `fit` of cameras of 62° to 120° before four fields, without doubtful fits."""
    rows = []
    for camera in CAMERAS:
        off, doubted = [], []
        for depth in DEPTHS:
            for seed in _seeds(rng, max(draws // 8, 1)):
                s = simulated(seed, (), epochs=60)
                f = fitted(before(Scene(rng, FIELD_MM / 2, camera=camera, depth=depth), s))
                if "rates_hang_on_c" in f.fitted:
                    doubted.append(depth)
                    continue
                off.append(rate_errors(f, s))
        print(f"({camera}: {len(doubted)} doubtful fits, field {set(doubted)})", file=sys.stderr)
        rows.append(ratio("`fit`", f"sd of the rates of c, x0, y0; {camera}, field 0.01 mm",
                          "noise of image and thermometer", np.array(off)))  # fmt: skip
    return rows


def seen_by_opencv(s: Any, noise_px: float = 0.04) -> SeriesInput:
    """Return the series that OpenCV's model gives with changing f: distortion follows the angle."""
    import cv2

    source, m = seen(s), s.model
    sensor, start, eop = m.sensor, m.interior.as_array(), s.truth.eop[0]
    c0, A, B = start[0], start[3:6], start[6:8]
    k = np.array([A[0] * c0**2, A[1] * c0**4, -B[1] * c0, B[0] * c0, A[2] * c0**6])
    x = np.eye(3)
    for axis, angle in zip(np.eye(3), eop[:3], strict=True):
        x = x @ cv2.Rodrigues(axis * angle)[0]
    # object axes to OpenCV's camera: x right, y down, z forward
    turn = np.diag([1.0, -1.0, -1.0]) @ x.T
    points = np.empty(source.grid.points.shape)
    centre = np.array([sensor.width - 1, sensor.height - 1]) / 2.0
    for e, (c, x0, y0) in enumerate(s.truth.iop[:, :3] / sensor.pixel_pitch):
        K = np.array([[c, 0, centre[0] + x0], [0, c, centre[1] - y0], [0, 0, 1]])
        points[e] = cv2.projectPoints(
            s.field.points, cv2.Rodrigues(turn)[0], -turn @ eop[3:], K, k
        )[0][:, 0]  # fmt: skip
    points += np.random.default_rng([s.seed, 7]).normal(0, noise_px, points.shape)
    points[~source.grid.observed] = np.nan
    return replace(source, grid=replace(source.grid, points=points))


def distortion(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit a camera whose distortion follows the angle while c changes, computed by OpenCV."""
    rates, wrong = [], []
    for seed in _seeds(rng, draws):
        s = simulated(seed, ())
        f = fitted(seen_by_opencv(s))
        rates.append(rate_errors(f, s))
        wrong.append(f.model.distortion != "angle")
    return [
        ratio("`fit`", "sd of the rates of c, x0, y0; rendered by OpenCV with changing f",
              "noise of image and thermometer", np.array(rates)),
        share("`fit`", "distortion reported as fixed in the image; it follows the angle",
              "3 sd", wrong),
    ]  # fmt: skip


def read_apart(s: Any, late: float, interval: float = 15.0, noise_k: float = 0.05) -> SeriesInput:
    """Return the series with a thermometer read between the frames, its clock `late` s ahead."""
    source, true = seen(s), s.true_history
    rng = np.random.default_rng([s.seed, 8])
    times = np.arange(rng.uniform(0, interval), s.frame_times[-1], interval)
    T = np.interp(times, true.reading_times, true.readings[true.reference])
    readings = {true.reference: T + rng.normal(0, noise_k, len(T))}
    begin = source.frame_times[0] - s.frame_times[0]
    return replace(
        source, reading_times=times + late + begin, readings=readings,
        resolutions={true.reference: None},
    )  # fmt: skip


def switched(seed: int) -> Any:
    """Simulate a camera without effects whose lamp is switched at any instant between frames."""
    begin, until = np.random.default_rng([seed, 9]).uniform(0.0, 10.0, 2)
    return simulated(seed, (), begin=80.0 + begin, until=500.0 + until)


def delay(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit a logger, its clock wrong by up to 90 s, read between frames every 10 to 60 s."""
    shifts, rates = [], []
    for interval in (10.0, 15.0, 30.0, 60.0):
        shift, rate = [], []
        for seed in _seeds(rng, draws):
            s = switched(seed)
            late = float(rng.uniform(-90.0, 90.0))
            source = read_apart(s, late, interval)
            f = fitted(source, ModelEffect("time_offset", {"d": 0.0}))
            if {"read_seldom", "read_poorly"} & set(f.fitted):
                continue
            shift.append((f.model.effects[0].values["d"] + late) / f.model.sd("time_offset.d"))
            rate.append(rate_errors(f, s))
        what = f"readings of {interval:g} s, ± 0.05 K"
        if len(shift) <= draws // 4:
            print(f"({what}: {len(shift)} of {draws} fits not doubtful)", file=sys.stderr)
            continue
        shifts.append(ratio("`fit`", f"sd of a clock's shift, ± 90 s; {what}",
                            "noise of image and thermometer", np.array(shift)))  # fmt: skip
        rates.append(ratio("`fit`", f"sd of the rates of c, x0, y0 beside it; {what}",
                           "noise of image and thermometer", np.array(rate)))  # fmt: skip
    return shifts + rates


def rate_errors(fit: ThermalCamera, s: Any) -> list[float]:
    """Return error over sd of the rates of c, x0, y0."""
    model, true = fit.model, s.model.rates
    return [(model.rates[n] - true[n]) / model.sd(f"rates.{n}") for n in NAMES]


def _seeds(rng: np.random.Generator, draws: int) -> list[int]:
    return [int(seed) for seed in rng.integers(0, 2**31, draws)]


def thermal(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit `fit` (rates, a lag's time, level), and `predict` and `correct` with its model."""
    rates, tau, level, predicted, corrected = [], [], [], [], []
    for seed in _seeds(rng, draws):
        s = simulated(seed)
        truth = s.model
        f = fitted(seen(s, rng), ModelEffect("thermal_lag", {"tau": 10.0}))
        tau.append((f.model.effects[0].values["tau"] - TAU) / f.model.sd("thermal_lag.tau"))
        rates.append(rate_errors(f, s))
        start = truth.interior.as_array() + (f.model.T0 - truth.T0) * truth.rate_vector
        off = f.model.interior.as_array() - start
        level.append([off[IOP_NAMES.index(n)] / f.model.sd(f"interior.{n}") for n in NAMES])
        camera = ThermalCamera(f.model)
        state = camera.at(NEAR)
        steady = truth.interior.as_array() + (NEAR - truth.T0) * truth.rate_vector
        predicted.append([(getattr(state.interior, n) - steady[IOP_NAMES.index(n)]) / state.sd[n]
                          for n in NAMES])  # fmt: skip
        corrected.append(_corrected(s, camera))
    return [
        ratio("`fit`", "sd of the rates of c, x0, y0", "noise of image and thermometer",
              np.array(rates)),
        ratio("`fit`", "sd of the lag τ", "noise of image and thermometer", np.array(tau)),
        ratio("`fit`", "sd of the level: c, x0, y0 at T₀; field 0.02 mm",
              "both noises, the field's coordinates", np.array(level)),
        ratio("`predict`", "sd of c, x0, y0 at 35 °C; field 0.02 mm",
              "the model's covariance", np.array(predicted)),
        ratio("`correct`", "sd of a corrected point, 15 K from T₀ to the steady camera",
              "the model's covariance, noise of the log", np.array(corrected)),
    ]  # fmt: skip


NOISY_K = 0.15


def thermometer(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit `correct` and `predict --log` with the log of a thermometer of 0.15 K noise."""
    moved, predicted = [], []
    for seed in _seeds(rng, draws):
        s = simulated(seed, ())
        source = seen(s)
        readings = {n: v + rng.normal(0, NOISY_K, len(v)) for n, v in source.readings.items()}
        camera = ThermalCamera(fitted(replace(source, readings=readings)).model)
        log = TemperatureLog(source.reading_times, readings)
        rows = rng.choice(np.arange(10, 110), 3, replace=False)
        times = source.frame_times[rows]
        drift = s.truth.iop[rows] - s.model.interior.as_array()
        drift -= (camera.model.T0 - s.model.T0) * s.model.rate_vector
        along = camera.along(log.times, dict(log.channels), times, relative_to=camera.model.T0,
                             temperature_sd=camera.thermometer_sd)  # fmt: skip
        off = (along.values - camera.model.interior.as_array() - drift)[:, :3]
        predicted.append((off / along.sd[:, :3]).ravel())
        steady = camera.model.interior.as_array()
        eop, points = s.truth.eop[0], s.field.points[:1]
        warm = np.concatenate([project(s.model.sensor, steady + d, eop, points) for d in drift])
        at_T0, sds, *_ = correct_points(
            camera, log, times, warm, temperature_sd=camera.thermometer_sd
        )
        off = (at_T0 - project(s.model.sensor, steady, eop, points)) / sds
        moved.append(off.ravel())
    return [
        ratio("`predict --log`", "sd of the change of c, x0, y0; thermometer ± 0.15 K",
              "the model's covariance, noise of the log", np.array(predicted)),
        ratio("`correct`", "sd of a corrected point; thermometer ± 0.15 K",
              "the model's covariance, noise of the log", np.array(moved)),
    ]  # fmt: skip


def _corrected(s: Any, camera: ThermalCamera) -> list[float]:
    """Return error over sd of points seen at a constant 40 °C and corrected to 25 °C."""
    truth = s.model
    start = truth.interior.as_array()
    warm, cool = (
        follow_angle(start + (T - truth.T0) * truth.rate_vector, start[0]) for T in (40, 25)
    )
    eop = s.truth.eop[0]
    rows = np.flatnonzero(s.model.sensor.contains(project(truth.sensor, cool, eop, s.field.points)))
    points = s.field.points[rows[:: max(1, len(rows) // 3)][:3]]
    log = TemperatureLog(np.arange(3.0), {"temperature": np.full(3, 40.0)})
    at_25, sds, *_ = correct_points(
        camera, log, np.ones(len(points)), project(truth.sensor, warm, eop, points), to=25.0
    )
    off = (at_25 - project(truth.sensor, cool, eop, points)) / sds
    return [float(v) for v in off.ravel()]


UNKNOWN = (
    ("thermal_lag", {"tau": 150.0}, {}),
    ("hysteresis", {"half_width": 2.0}, {}),
    ("time_offset", {"d": 60.0}, {}),
    ("nonlinear_expansion", {}, {"c": 2e-6, "x0": 6e-6, "y0": -4e-6}),
    ("permanent_set", {}, {"c": 2e-5, "x0": 6e-5, "y0": -4e-5}),
    ("creep", {}, {"c": 3e-7, "x0": 1e-6, "y0": -8e-7}),
    ("self_heating", {"tau": 300.0}, {"c": 3e-4, "x0": 9e-4, "y0": -6e-4}),
    ("softening", {"T_k": 34.0}, {"c": 2e-5, "x0": 6e-5, "y0": -4e-5}),
    ("thermal_gradient", {}, {"c": 2e-3, "x0": 6e-3, "y0": -4e-3}),
)
"""Effects that a fit does not include, with their times and sizes; the sizes, or else the times,
are multiplied by a factor drawn for each case."""


def outside(draws: int, rng: np.random.Generator) -> list[Row]:
    """Count the prediction bands that do not hold where the model lacks the camera's effect."""
    found = []
    for seed in _seeds(rng, draws):
        name, times, sizes = UNKNOWN[int(rng.integers(len(UNKNOWN)))]
        size = float(np.exp(rng.uniform(np.log(0.03), 0.0)))
        shrunk = {k: max(v * size, 1.0) for k, v in times.items()} if not sizes else times
        effect = ModelEffect(name, {**shrunk, **{k: v * size for k, v in sizes.items()}})
        first = fitted(seen(simulated(seed, (effect,))))
        second = simulated(seed + 1, (effect,), power=6.5, until=700.0, series="M2")
        reduced = reduce_series(seen(second), strict=False)
        error = predicted_error(first.model, reduced, first.fitted["series"][0].thermometer_sd)
        found.append(bool(error.coverage < 0.9))
    return [share("`predict --test`", "a band that holds less than 90 %; an effect not given "
                  "to `fit`", "no band where an effect is missing", found)]  # fmt: skip


def discovery(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit the estimates of effects that `discover` finds, and the model it writes."""
    tau, level, rates = [], [], []
    for seed in _seeds(rng, draws):
        s = simulated(seed, epochs=60)
        found = discover_series([reduce_series(seen(s, rng))])
        entry = next((e for e in found.effects if e.effect == "thermal_lag"), None)
        if entry is None:
            continue
        estimate = entry.estimates["tau"]
        tau.append((estimate["value"] - TAU) / estimate["sd"])
        model = build_model(found)
        start = s.model.interior.as_array() + (model.T0 - s.model.T0) * s.model.rate_vector
        off = model.interior.as_array() - start
        level.append([off[k] / model.sds[f"interior.{n}"] for k, n in enumerate(NAMES)])
        rates.append([(model.rates[n] - s.model.rates[n]) / model.sds[f"rates.{n}"]
                      for n in NAMES])  # fmt: skip
    return [
        ratio("`discover`", "sd of the lag τ", "noise of image and thermometer", np.array(tau)),
        ratio("`discover`", "sd of the written rates of c, x0, y0",
              "noise of image and thermometer", np.array(rates)),
        ratio("`discover`", "sd of the written level: c, x0, y0 at T₀; field 0.02 mm",
              "both noises, the field's coordinates", np.array(level)),
    ]  # fmt: skip
