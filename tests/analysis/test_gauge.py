"""A camera without a test field: predicted from readings, resected from control points.

The image points are from `tests.main_paths.crooked`, whose projection shares no code with the
program.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.main_paths.crooked import CAMERA, PITCH, SIZE, project
from tests.marks import mostly_slow
from thermocald.acquisition.calibrator import Calibrator
from thermocald.analysis.camera.camera import Camera
from thermocald.analysis.thermal.gauge import GaugeCalibrator
from thermocald.analysis.thermal.predictor import Predictor
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
from thermocald.photogrammetry.epoch.measuring import Plane, place_on
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.physics.model import ModelEffect, ThermalModel
from thermocald.store.recording.reader import read_recording
from thermocald.store.series import EpochResult

POSE = np.array([np.deg2rad(70.0), 0.02, -0.01, 500.0, -1000.0, 6000.0])
NAMES = ("c", "x0", "y0")
RATES = {"c": 0.4e-3, "x0": 0.35e-3, "y0": -0.2e-3}
SD = {"c": 0.5e-3, "x0": 0.6e-3, "y0": 0.6e-3}
SD_RATE, NOISE_PX, SURVEY_MM = 4e-6, 0.1, 8.0
TAU = 600.0
START = 1.7e9


def thermal_camera(tau: float | None = None) -> ThermalCamera:
    """Return the crooked camera, valid from -5 to 45 °C, with T0 = 20 °C; tau: of a lag, s."""
    parameters = [f"interior.{n}" for n in NAMES] + [f"rates.{n}" for n in NAMES]
    covariance = np.diag([SD[n] ** 2 for n in NAMES] + [SD_RATE**2] * 3).tolist()
    effects = () if tau is None else (ModelEffect("thermal_lag", {"tau": tau}, {}),)
    return ThermalCamera(
        ThermalModel(
            name="gauge", camera="gauge", sensor=Sensor(*SIZE, PITCH), T0=20.0,
            interior=InteriorOrientation(**CAMERA), rates=RATES, effects=effects,
            validity={"temperature": (-5.0, 45.0)}, covariance=covariance,
            covariance_names=tuple(parameters),
        )
    )  # fmt: skip


class World:
    """One gauge: its control points, its true camera, its observations."""

    def __init__(self, seed: int, n: int = 12) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.off = {k: rng.normal(0, SD[k]) for k in NAMES}
        self.rate = {k: RATES[k] + rng.normal(0, SD_RATE) for k in NAMES}
        y = rng.uniform(8_000, 28_000, n)
        side = np.where(np.arange(n) % 2, 0.3, -0.3) * y
        self.points = np.column_stack([side, y, rng.uniform(-200, 2_500, n)])
        surveyed = self.points + rng.normal(0, SURVEY_MM, self.points.shape)
        self.field = TestField.build([f"g{i}" for i in range(n)], surveyed, SURVEY_MM)
        self.pose = POSE.copy()

    def interior(self, T: float) -> dict[str, float]:
        return {k: CAMERA[k] + self.off[k] + self.rate[k] * (T - 20.0) for k in NAMES}

    def seen(self, T: float, rows=None) -> Observations:
        rows = np.arange(len(self.field)) if rows is None else np.asarray(rows)
        at = project(self.points[rows], self.pose, **self.interior(T))
        noise = self.rng.normal(0, NOISE_PX, at.shape)
        return Observations(rows, at + noise, np.full(at.shape, NOISE_PX))

    def epoch(self, k: int, T: float, rows=None, period: float = 10.0) -> Epoch:
        time = START + period * k
        seen = self.seen(T, rows) if rows is None or len(rows) else Observations.none()
        return Epoch(k, time, time, {"housing": T}, observations=seen)


def followed(gauge: GaugeCalibrator, epochs):
    """Return the results of epochs, their statuses, and the reported events (kind, text)."""
    events = []
    gauge.tell = lambda kind, text, *_: events.append((kind, text))
    results = []
    for epoch in epochs:
        done = gauge.calibrate(epoch)
        gauge.observe(done)
        results.append(done)
    return results, [r.adjustment.status for r in results], events


def pose_error(result, world: World) -> float:
    """Return a pose's error over its sds, the root mean square of its six numbers."""
    error = result.exterior.as_array() - world.pose
    error[:3] = np.arctan2(np.sin(error[:3]), np.cos(error[:3]))
    return np.sqrt(error @ np.linalg.solve(result.covariance[10:, 10:], error) / 6)


@pytest.mark.parametrize("status", ["predicted", "resected"])
def test_predictions_and_poses_have_true_sds(status):
    """Without control points, and with them; the thermometer has 0.05 K of noise."""
    square = []
    for seed in range(60):
        world, T = World(100 + seed), 38.0
        control = world.field if status == "resected" else None
        gauge = GaugeCalibrator(thermal_camera(), control, snooping_alpha=0.0)
        epoch = replace(world.epoch(1, T), temperatures={"h": T + world.rng.normal(0, 0.05)})
        result = gauge.calibrate(epoch).adjustment
        assert result.status == status, result.reason
        if control is not None:
            square.append(pose_error(result, world) ** 2)
            continue
        assert result.exterior is None
        error = result.interior.as_array()[:3] - np.array(list(world.interior(T).values()))
        square.append((error / result.sd[:3]) ** 2)
    assert np.sqrt(np.mean(square)) == pytest.approx(1.0, abs=0.12)


def read(temperatures, period: float = 10.0) -> list[Epoch]:
    """Return epochs without control points."""
    times = START + period * np.arange(len(temperatures))
    return [Epoch(k, t, t, {"h": temperatures[k]}) for k, t in enumerate(times.tolist())]


def test_outside_the_range_is_reported_and_far_outside_nothing_is_predicted():
    results, words, events = followed(
        GaugeCalibrator(thermal_camera()), read([20.0, 44.9, 55.0, 90.0, 44.0], 3600.0)
    )
    assert words == ["predicted", "predicted", "outside_range", "outside_range", "predicted"]
    _, inside, outside, far, _ = (r.adjustment for r in results)
    assert outside.sd[0] > 2 * inside.sd[0]
    assert far.interior is None
    assert "−5 to 45 °C" in far.reason
    assert [kind for kind, _ in events] == ["outside_range", "predicted"]
    gauge = GaugeCalibrator(thermal_camera())
    gauge.predictor.take(START, {"h": 20.0})
    now = gauge.predictor.at(START)
    heated = replace(now, camera=replace(now.camera, extrapolated=3.0))
    gauge.predictor.at = lambda _: heated
    other = gauge.calibrate(read([20.0])[0]).adjustment
    assert (other.status, "another thermometer is 3.0 K" in other.reason) == ("outside_range", True)
    square = ModelEffect("square(offset(temperature, 20.0))", {"c": 3e-5}, {})
    model = replace(thermal_camera().model, effects=(square,))
    predictor = Predictor(ThermalCamera(model))  # by the drift of all effects, not the rates alone
    predictor.take(0.0, {"temperature": 55.0})
    slope = RATES["c"] + 2 * 3e-5 * 35.0
    wanted = slope**2 * (10.0**2 + predictor.thermal.reading_sd**2)
    assert predictor.at(1.0).noise[0, 0] == pytest.approx(wanted, rel=1e-3)


def test_the_covariance_grows_while_a_thermometer_is_lost():
    results, words, events = followed(
        GaugeCalibrator(thermal_camera()), read([20.0, math.nan, math.inf, math.nan, 21.0], 300.0)
    )
    assert words == ["predicted", *["no_temperature"] * 3, "predicted"]
    sd = [r.adjustment.sd[1] for r in results]
    assert sd[0] < sd[1] < sd[2] < sd[3]
    assert sd[4] == pytest.approx(sd[0], rel=0.1)
    assert [kind for kind, _ in events] == ["no_temperature", "predicted"]


def test_a_reading_that_jumps_is_no_temperature():
    """Of 30 °C between two of 20 °C, and one that stays: the camera was 5 sds off, unsaid."""
    results, words, events = followed(
        GaugeCalibrator(thermal_camera()), read([20.0, 20.1, 30.0, 20.1, 21.0, 22.0], 60.0)
    )
    assert words == ["predicted"] * 2 + ["no_temperature"] + ["predicted"] * 3
    sd = [r.adjustment.sd[1] for r in results]
    assert sd[2] == pytest.approx(np.hypot(sd[1], 9.9 * RATES["x0"]), rel=0.02)
    assert "jumped by 9.9 K" in events[0][1]
    stays = read([20.0, 20.1, *[30.0] * 8], 60.0)
    _, words, events = followed(GaugeCalibrator(thermal_camera()), stays)
    # until the temperature may have changed by as much: it was said once
    assert words == ["predicted"] * 2 + ["no_temperature"] * 5 + ["predicted"] * 3
    assert len(events) == 2
    narrow = replace(thermal_camera().model, validity={"h": (10.0, 20.0)})
    later = Predictor(ThermalCamera(narrow))
    for hours, T in ((0.0, 9.8), (24.0, 22.0)):
        later.take(START + 3600.0 * hours, {"h": T})
    assert later.at(START + 86400.0).jump == 0.0


def test_a_delayed_epoch_has_the_camera_of_its_time():
    gauge, epochs = GaugeCalibrator(thermal_camera()), read(20.0 + 0.1 * np.arange(50))
    results, *_ = followed(gauge, epochs)
    late = gauge.calibrate(epochs[9]).adjustment
    assert late.interior.c == pytest.approx(results[9].adjustment.interior.c, abs=1e-12)
    now = gauge.calibrate(replace(epochs[-1], number=51, frame_time=START + 510.0))
    assert now.adjustment.interior.c == pytest.approx(results[-1].adjustment.interior.c)
    gauge.predictor.take(START + 2000.0, {"h": 25.0})
    in_gap = gauge.calibrate(replace(epochs[-1], number=60, frame_time=START + 1000.0)).adjustment
    assert "reading is 510 s old" in in_gap.reason  # raised DataError
    assert in_gap.sd[1] > 2 * late.sd[1]


@pytest.mark.parametrize("between", [0.0, 4.0])
@pytest.mark.parametrize("effect", ["thermal_lag", "time_offset"])
def test_the_noise_of_readings_is_that_along_the_log(effect, between):
    """Followed reading by reading, it is the same as by the effects' operators."""
    values = {"thermal_lag": {"tau": 45.0}, "time_offset": {"d": 23.0}}[effect]
    model = replace(thermal_camera().model, effects=(ModelEffect(effect, values, {}),))
    camera = ThermalCamera(model)
    predictor, times = Predictor(camera), 10.0 * np.arange(40)
    for time in times:
        predictor.take(time, {"temperature": 20.0})
    last = times[-1] - (20.0 + between if between else 0.0)
    sds = (0.0, camera.reading_sd)
    a, b = (camera.along(times, 20.0 + 0.0 * times, [last], temperature_sd=sd) for sd in sds)
    found, wanted = predictor.at(last).noise, (b.covariance - a.covariance)[0]
    np.testing.assert_allclose(found[:3, :3], wanted[:3, :3], rtol=1e-4)


def unknown(predictor: Predictor, begin: float, T: float, *rows: int) -> list[float]:
    """Return the effects of the unknown past, px, at some of 750 readings of a temperature."""
    found = []
    for k in range(750):
        predictor.take(begin + 10.0 * k, {"h": T})
        if k in rows:
            found.append(predictor.at(begin + 10.0 * k).unknown_px)
    return found


def test_the_effects_of_the_unknown_past_and_of_a_gap_fade():
    """With a lag of 600 s it is more than a pixel at first, and nothing after two hours."""
    predictor = Predictor(thermal_camera(TAU))
    first, later, last = unknown(predictor, START, 20.0, 0, 60, 720)
    assert first > 1.0
    assert later / first == pytest.approx(np.exp(-600.0 / TAU), rel=0.05)
    assert last < 1e-3
    after, end = unknown(predictor, START + 7490.0 + 3 * 3600.0, 24.0, 0, 500)
    assert after > 0.2
    assert end < 1e-3 * after
    # five minutes: a trapezium whose height is the change that half of them allow, through the lag
    (short,) = unknown(predictor, START + 14980.0 + 3 * 3600.0 + 300.0, 24.0, 0)
    t = np.arange(0.05, 300.0, 0.1)
    lagged = 0.1 / TAU * np.interp(t, [0, 30, 270, 300], [0, 1, 1, 0]) @ np.exp((t - 300.0) / TAU)
    before = TAU / 60.0 * -np.expm1(-60.0 / TAU)  # at first, within a minute
    height = np.sqrt(-np.expm1(-2.0 * 150.0 / 21600.0))
    assert short / first == pytest.approx(height * lagged / before, rel=0.01)


@pytest.mark.slow
def test_the_state_after_a_restart_has_true_sds():
    """80 draws of a camera with a lag, whose past temperature is unknown: error over sd."""
    rng = np.random.default_rng(7)
    model = replace(thermal_camera(TAU).model, fitted_on=({"thermometer_sd_K": 0.0},))
    exact, ratio = ThermalCamera(model), []
    for _ in range(80):
        before = 20.0 + rng.normal(0, 50.0 / np.sqrt(12.0))
        predictor = Predictor(exact)
        truth, T = before, 20.0
        for k in range(90):
            truth = T + (before - T) * np.exp(-10.0 * k / TAU)
            predictor.take(START + 10.0 * k, {"h": T})
        at = predictor.at(START + 890.0)
        error = at.camera.values[0] - (CAMERA["c"] + RATES["c"] * (truth - 20.0))
        past = at.camera.covariance[0, 0] - thermal_camera().at(20.0).covariance[0, 0]
        ratio.append(error / np.sqrt(past))
    assert np.std(ratio) == pytest.approx(1.0, abs=0.2)


def test_remembered_epochs_restore_the_state():
    world, camera = World(3), thermal_camera(TAU)
    epochs = [world.epoch(k, 20.0 + 0.06 * k) for k in range(1, 100)]
    results, *_ = followed(GaugeCalibrator(camera, world.field), epochs)
    second = GaugeCalibrator(camera, world.field)
    second.remember(
        SimpleNamespace(epoch=done.epoch, result=EpochResult.from_adjustment(done.adjustment))
        for done in results[:-1]
    )
    again, last = second.calibrate(epochs[-1]).adjustment, results[-1].adjustment
    assert again.status == "resected"
    assert again.values == pytest.approx(last.values, rel=1e-9)
    assert again.sd == pytest.approx(last.sd, rel=1e-9, nan_ok=True)


def test_the_last_pose_is_kept_with_growing_covariance_while_points_are_hidden():
    world = World(5)
    gauge = GaugeCalibrator(thermal_camera(), world.field, mount_sd_deg=0.01)
    shown = [None, None, [0, 1], [], [4], None]
    epochs = [world.epoch(k, 25.0, rows, 600.0) for k, rows in enumerate(shown, 1)]
    results, words, events = followed(gauge, epochs)
    assert words == ["resected"] * 2 + ["last_pose"] * 3 + ["resected"]
    sd = [r.adjustment.sd[10] for r in results]
    assert sd[1] < sd[2] < sd[3] < sd[4]
    grown = np.sqrt(sd[4] ** 2 - sd[1] ** 2)
    assert grown == pytest.approx(np.deg2rad(0.01) * np.sqrt(0.5), rel=1e-6)
    assert [kind for kind, _ in events] == ["last_pose", "resected"]
    assert "control points are seen" in events[0][1]
    # processed late, it is as long before the last pose as the fifth is after the second
    late = gauge.calibrate(replace(world.epoch(3, 25.0, [], 600.0), number=3)).adjustment
    assert np.sqrt(late.sd[10] ** 2 - results[5].adjustment.sd[10] ** 2) == pytest.approx(
        np.deg2rad(0.01) * np.sqrt(0.5), rel=1e-6
    )


def test_places_from_the_last_pose_have_true_sds():
    """Camera and pose were uncorrelated in such a row: the sds were 1.7 times too large."""
    ratio, level = [], Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    on_water = np.array([[300.0, 9e3, 0.0], [-2e3, 2e4, 0.0], [2_500.0, 14e3, 0.0]])
    for seed in range(60):
        world = World(800 + seed)
        gauge = GaugeCalibrator(thermal_camera(), world.field, snooping_alpha=0.0)
        gauge.calibrate(world.epoch(1, 20.0))
        result = gauge.calibrate(world.epoch(2, 30.0, [], 600.0)).adjustment
        assert result.status == "last_pose"
        seen = project(on_water, POSE, **world.interior(30.0)) + world.rng.normal(0, 0.1, (3, 2))
        places, C = place_on(gauge.sensor, result.values, result.covariance, seen, 0.1, level)
        ratio.append((places - on_water)[:, :2] / np.sqrt(C.diagonal()).reshape(3, 3)[:, :2])
    assert np.sqrt(np.mean(np.square(ratio))) == pytest.approx(1.0, abs=0.15)


def test_a_moved_camera_is_reported_with_time_turn_and_shift():
    turn = np.array([0.0, np.deg2rad(0.05), 0.0, 0.0, 0.0, 0.0])
    found = 0
    for seed in range(6):
        world = World(200 + seed)
        gauge = GaugeCalibrator(thermal_camera(), world.field)
        epochs = [world.epoch(k, 20.0 + 0.1 * k) for k in range(16, 31)]
        world.pose = POSE + turn
        epochs += [world.epoch(k, 20.0 + 0.1 * k) for k in range(31, 37)]
        results, _, events = followed(gauge, epochs)
        moved = [r.epoch.number for r in results if "event" in r.extra]
        assert [kind for kind, _ in events] == ["camera_moved"] * len(moved)
        assert len(moved) <= 1
        if moved:
            found += moved[0] == 32
            assert "turned by 0.0" in events[0][1]
            assert "looks the same" not in events[0][1]
    assert found == 6


def moved_stones(seed: int, shift: float):
    """Calibrate after two of twelve control points have moved, in an order drawn at random."""
    world, rng = World(4000 + seed), np.random.default_rng(seed)
    ways = rng.normal(size=(2, 3))
    gauge = GaugeCalibrator(thermal_camera(), world.field)
    gauge.calibrate(world.epoch(1, 20.0))
    moved = shift * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    world.points[rng.choice(12, 2, False)] += moved
    return world, gauge.calibrate(world.epoch(2, 20.0, rng.permutation(12))).adjustment


def nearly_on_a_line(seed: int, survey_mm: float):
    """Calibrate with four points along a line, surveyed as badly as stated."""
    world, rng = World(9000 + seed, 4), np.random.default_rng(seed)
    along = rng.uniform(8_000, 28_000, 4)
    across, up = rng.normal(size=(2, 4)) * [[500.0], [300.0]]
    world.points = np.column_stack([0.25 * along + across, along, up])
    surveyed = world.points + rng.normal(0, survey_mm, (4, 3))
    world.field = TestField.build(world.field.names, surveyed, survey_mm)
    gauge = GaugeCalibrator(thermal_camera(), world.field)
    return world, gauge.calibrate(world.epoch(1, 30.0)).adjustment


def in_fog(seed: int, seen: int, knocked: bool, wrong_px: float = 0.0):
    """Calibrate with few points of twelve in sight, after a knock or without; one may be wrong."""
    world = World(700 + seed)
    gauge = GaugeCalibrator(thermal_camera(), world.field, mount_sd_deg=0.01)
    gauge.calibrate(world.epoch(1, 20.0))
    if knocked:
        turn = world.rng.choice([-1, 1], 3) * world.rng.uniform(0.05, 0.2, 3)
        world.pose = POSE + np.concatenate([np.deg2rad(turn), world.rng.normal(0, 30, 3)])
    epoch = world.epoch(2, 21.0, world.rng.choice(12, seen, False), 60.0)
    epoch.observations.points[0] += world.rng.choice([-1, 1], 2) * wrong_px
    result = gauge.calibrate(epoch).adjustment
    assert result.exterior is not None or "was the camera moved?" in result.reason
    return world, result


def surveyed_badly_from_near(seed: int):
    """Calibrate with six points at 4 to 12 m whose sds of 50 mm are 20 px in the image."""
    world, rng = World(seed, 6), np.random.default_rng(seed)
    world.points = POSE[3:] + 0.4 * (world.points - POSE[3:])
    surveyed = world.points + rng.normal(0, 50.0, (6, 3))
    world.field = TestField.build(world.field.names, surveyed, 50.0)
    return world, GaugeCalibrator(thermal_camera(), world.field).calibrate(
        world.epoch(1, 20.0)
    ).adjustment


@pytest.mark.parametrize(
    ("calibrated", "options", "seeds", "at_least"),
    [
        # once 10 and 22 of 60 had a pose, without a defect of the others
        (moved_stones, (77.0,), 20, 13),
        (moved_stones, (200.0,), 20, 17),
        # some had another pose, up to a thousand sds off, without a word
        (nearly_on_a_line, (30.0,), 40, 5),
        # of three points 22 of 25 poses were up to thirty sds off, of four and five one in ten
        *((in_fog, (n, False, px), 20, 18) for n in (3, 4, 5) for px in (5.0, 20.0)),
        # 15 of 100 had none: a start of three points fits the others no better than the survey
        (surveyed_badly_from_near, (), 30, 27),
        # one or two points left 13 and 15 of 60 false poses: their survey's errors hid a knock
        *((in_fog, (n, True), 20, 0) for n in (1, 2, 3)),
        *((in_fog, (n, False), 20, 20) for n in (1, 2, 3)),
    ],
)
def test_there_is_a_true_pose_or_none(calibrated, options, seeds, at_least):
    ratio = []
    for seed in range(seeds):
        world, result = calibrated(seed, *options)
        if result.exterior is not None:
            ratio.append(pose_error(result, world))
    assert len(ratio) >= at_least
    assert np.max(ratio, initial=0.0) < 3.0
    assert not ratio or np.sqrt(np.mean(np.square(ratio))) == pytest.approx(1.0, abs=0.25)


def test_a_repeated_frame_is_no_second_pose():
    """Two different poses in a row are a movement: one wrong frame, delivered twice, is not."""
    world = World(208)
    gauge = GaugeCalibrator(thermal_camera(), world.field)
    epochs = [world.epoch(k, 20.0) for k in range(1, 8)]
    seen = epochs[4].observations
    moved = replace(seen, points=seen.points + np.array([1.0, 0.0]))
    epochs[4:6] = (replace(epoch, observations=moved) for epoch in epochs[4:6])
    results, statuses, events = followed(gauge, epochs)
    assert statuses == [*["resected"] * 5, "repeated_frame", "resected"]
    assert results[5].epoch.observations is None
    assert "epoch 5" in results[5].adjustment.reason
    assert not events


def test_a_missing_effect_is_reported_unlike_a_knock():
    """c has a quadratic term that the model lacks, which no single frame shows."""
    world = World(700)
    plain = world.interior
    world.interior = lambda T: plain(T) | {"c": plain(T)["c"] + 3e-5 * (T - 20.0) ** 2}
    gauge = GaugeCalibrator(thermal_camera(), world.field)
    *_, events = followed(gauge, [world.epoch(k, 20.0 + 0.5 * k) for k in range(1, 50)])
    assert {kind for kind, _ in events} == {"camera_moved"}
    assert all("a missing effect looks the same" in text for _, text in events)


@pytest.mark.slow
@pytest.mark.parametrize("lag", [None, TAU], ids=["40 K", "a fading past"])
def test_no_movement_is_reported_without_one(lag):
    """In changing heat, with one point hidden in most epochs; and out of a warm room with a lag."""
    for seed in range(3 if lag is None else 5):
        world = World(300 + seed)
        gauge = GaugeCalibrator(thermal_camera(lag), world.field)
        epochs, warm = [], world.rng.normal(20.0, 12.0)
        for k in range(1, 301 if lag is None else 121):
            if lag is None:
                rows = np.delete(np.arange(12), k % 12) if k % 3 else None
                epochs.append(world.epoch(k, 0.13 * k, rows))
            else:
                lens = 20.0 + (warm - 20.0) * np.exp(-10.0 * k / lag)
                epochs.append(replace(world.epoch(k, lens), temperatures={"housing": 20.0}))
        assert followed(gauge, epochs)[2] == []


def test_the_movement_has_true_sds():
    square = []
    for seed in range(60):
        world = World(400 + seed)
        gauge = GaugeCalibrator(thermal_camera(), world.field, snooping_alpha=0.0)
        gauge.calibrate(world.epoch(1, 10.0))
        then = gauge.pose
        world.pose = POSE + np.array([2e-3, -1e-3, 1e-3, 30.0, -20.0, 10.0])
        epoch = world.epoch(2, 25.0, period=3600.0)
        gauge.calibrate(epoch)
        found = gauge.compare(then, gauge.pose)
        error = found.values - (world.pose - POSE)
        square.append(error @ np.linalg.solve(found.covariance, error) / 6)
    # the stated noise includes 0.05 px for light and air, absent here
    allowed = np.sqrt((2 * NOISE_PX**2) / (2 * NOISE_PX**2 + 0.05**2))
    assert np.sqrt(np.mean(square)) == pytest.approx(allowed, abs=0.12)


@pytest.mark.parametrize("number", mostly_slow([0, 1, 2, 6], 1))
def test_real_poses_of_eight_corners_agree_with_those_of_the_whole_field(shared, number):
    """Two boards of a real room as control points, 25 pairs per camera.

    The camera is from the whole field, with its covariance. The sds include 2 mm of the
    coordinates, which both poses have in common, so the ratio is less than 1.
    """
    recording = read_recording(shared / "data" / f"aviary-cam{number}")
    epoch = next(e for e in recording.epochs if e.observations is not None)
    whole = Calibrator.of_recording(recording).calibrate(epoch).adjustment
    boards: dict[str, list[int]] = {}
    for row, target in enumerate(epoch.observations.targets):
        boards.setdefault(recording.testfield.names[target].split(".")[0], []).append(row)
    full = [board for board, rows in boards.items() if len(rows) == 4]
    known = whole.values[:10], whole.covariance[:10, :10]
    camera = Camera(recording.camera.sensor, math.nan, *known)
    rng = np.random.default_rng(number)
    ratio, posed = [], 0
    for _ in range(25):
        pair = rng.choice(full, 2, replace=False)
        rows = np.array(sorted(boards[pair[0]] + boards[pair[1]]))
        pose = camera.resect(recording.testfield, epoch.observations.select(rows))
        # the boards may be in one plane, or on one line
        assert pose.status in ("ok", "ambiguous_pose", "weak_geometry"), pose.reason
        if pose.ok:
            posed += 1
            ratio.append((pose.values[10:] - whole.values[10:]) / pose.sd[10:])
    assert posed >= 15
    assert np.sqrt(np.mean(np.square(ratio))) < 1.0
    assert np.abs(ratio).max() < 3.0
