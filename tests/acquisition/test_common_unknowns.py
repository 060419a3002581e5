"""What epochs share: against the adjustment of the whole series, and against the truth."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import replace

import numpy as np
import pytest

from thermocald.acquisition.calibrator import Calibrator
from thermocald.acquisition.common_unknowns import CommonUnknowns
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series import common_sums, exterior, system
from thermocald.photogrammetry.series import running as running_series
from thermocald.photogrammetry.series.adjustment import SeriesSettings, adjust_series
from thermocald.simulation.demonstration import demonstration_model
from thermocald.simulation.testfields import corner_field

NOISE = 0.04
FIELD_SD = 0.05  # mm


@pytest.fixture(scope="module")
def scene():
    """A camera that stands still and warms up before a field that is known to FIELD_SD."""
    plain = corner_field("plain", per_side=5, pitch_mm=124.0)
    model = demonstration_model(plain)
    rng = np.random.default_rng(8)
    given = plain.points + rng.normal(0, FIELD_SD, plain.points.shape)
    field = TestField.build(plain.names, given, FIELD_SD)
    iop, eop = model.interior.as_array(), model.exterior.as_array()

    def epoch(k: int, knocked: bool = False) -> tuple[Observations, np.ndarray]:
        now = iop.copy()
        now[:3] += np.array([2.0e-4, -4.5e-4, -3.0e-4]) * min(k, 40) * 0.25
        pose = eop + (np.array([0.002, 0, 0, 3.0, 0, 0]) if knocked else 0.0)
        points = project(model.sensor, now, pose, plain.points)
        points = points + rng.normal(0, NOISE, points.shape)
        rows = rng.permutation(len(plain))[: len(plain) - 15]  # some are hidden, now and then
        return Observations(rows, points[rows], np.full((len(rows), 2), NOISE)), now

    return model.sensor, field, epoch


def run(scene, epochs: int, settings=None, **options):
    sensor, field, epoch = scene
    settings = settings or AdjustmentSettings()
    calibrator = Calibrator(sensor, field, settings, nominal_c=3.04)
    common = CommonUnknowns(sensor, field, settings, **options)
    results, alone, truth, seen = [], [], [], []
    for k in range(epochs):
        observations, now = epoch(k)
        apart = calibrator.adjust(observations)
        results.append(common.refine(observations, apart))
        alone.append(apart)
        truth.append(now)
        seen.append(observations)
    return results, alone, np.array(truth), seen


@pytest.mark.parametrize(
    ("exterior", "epochs"), [("per_epoch", 15), ("series", 47), ("mount", 100), ("per_epoch", 100)]
)
def test_the_last_epochs_are_those_of_the_adjustment_of_the_whole_series(scene, exterior, epochs):
    """15 and 47: between two adjustments of all epochs; 100: where the sums carry on."""
    sensor, field, _ = scene
    results, alone, _, seen = run(scene, epochs, exterior=exterior, offsets=True)
    start = alone[-1]
    whole = adjust_series(
        sensor, field, seen,
        InteriorOrientation.from_array(start.values[:10]),
        ExteriorOrientation.from_array(start.values[10:]),
        replace(SeriesSettings.of(AdjustmentSettings(), exterior), snooping_alpha=0.001),
    )  # fmt: skip
    late = slice(-5, None)
    # the same but for borderline rejections, and common unknowns that are a few epochs old
    for result, row in zip(results[late], range(epochs)[late], strict=True):
        sd = np.hypot(whole.sd[row], whole.level_sd)[:3]
        assert (np.abs(result.values - whole.values[row])[:3] < 0.2 * sd).all()
        assert result.sd[:3] == pytest.approx(sd, rel=0.05)
        assert result.sigma0 == pytest.approx(whole.sigma0[row], rel=0.2)


def test_one_orientation_makes_the_principal_point_ten_times_as_sure_and_truly_so(scene):
    results, alone, truth, _ = run(scene, 40, exterior="series", offsets=True)
    late = slice(20, None)
    x0 = np.array([r.values[1] for r in results])[late] - truth[late, 1]
    x0_alone = np.array([r.values[1] for r in alone])[late] - truth[late, 1]
    assert np.std(x0) < 0.25 * np.std(x0_alone)
    # errors against the truth, the common ones included, are what the standard deviations say
    for i in range(3):
        error = np.array([r.values[i] for r in results])[late] - truth[late, i]
        sd = np.array([r.sd[i] for r in results])[late]
        assert np.abs(error / sd).max() < 4.0
        assert np.mean((error / sd) ** 2) < 4.0
    assert np.ptp([r.values[13] for r in results[-5:]]) < 0.2 * results[-1].sd[13]


def test_offsets_take_the_jumps_out_that_hidden_targets_make(scene):
    with_offsets, alone, truth, _ = run(scene, 40, exterior="per_epoch", offsets=True)
    late = slice(20, None)

    def scatter(results) -> float:
        c = np.array([r.values[0] for r in results])[late] - truth[late, 0]
        return float(np.std(c))

    assert scatter(with_offsets) < 0.85 * scatter(alone)


def test_an_epoch_that_was_moved_has_no_result_and_the_next_begins_anew(scene):
    sensor, field, epoch = scene
    settings = AdjustmentSettings()
    calibrator = Calibrator(sensor, field, settings, nominal_c=3.04)
    common = CommonUnknowns(sensor, field, settings, exterior="series", offsets=True)
    words = []
    for k in range(24):
        observations, _ = epoch(k, knocked=k >= 20)
        result = common.refine(observations, calibrator.adjust(observations))
        words.append(result.status)
    assert words == ["ok"] * 20 + ["moved"] + ["ok"] * 3
    assert common.epochs == 3


def test_gross_errors_in_most_epochs_are_found(scene):
    sensor, field, epoch = scene
    calibrator = Calibrator(sensor, field, AdjustmentSettings(), nominal_c=3.04)
    common = CommonUnknowns(sensor, field, AdjustmentSettings(), exterior="auto", offsets=True)
    for k in range(30):
        observations, now = epoch(k)
        points = observations.points.copy()
        points[: 3 if k % 3 else 0] += 20.0
        observations = replace(observations, points=points)
        result = common.refine(observations, calibrator.adjust(observations))
        assert result.ok
        if k % 3:
            assert set(observations.targets[:3]) <= set(result.rejected)
        assert (np.abs(result.values[:3] - now[:3]) < 4 * result.sd[:3]).all()


def test_nothing_shared_leaves_the_epoch_as_it_is(scene):
    results, alone, _, _ = run(scene, 3, exterior="per_epoch", offsets=False)
    assert all(a is b for a, b in zip(results, alone, strict=True))


def test_nothing_of_its_own_leaves_the_epoch_as_it_is(scene):
    sensor, field, _ = scene
    held = AdjustmentSettings(free=())
    assert not CommonUnknowns(sensor, field, held, exterior="series", offsets=True).any


def test_priors_and_what_is_held_are_kept(scene):
    settings = AdjustmentSettings(
        free=("c", "x0", "y0"), priors={"c": (3.1, 1e-6), "Z0": (1000.0, 1e9)}
    )
    results, _, _, _ = run(scene, 4, settings, exterior="series", offsets=True)
    good = [r for r in results if r.interior is not None]
    for r in good:
        assert r.values[0] == pytest.approx(3.1, abs=1e-4)
        assert (r.values[3:10] == 0).all()


def small_series(rng, exterior: str, tremble_px: float, epochs: int, field_sd=0.03, hidden=5):
    """Results of a running series of a camera that warms up, and the truth (epochs, 16)."""
    plain = corner_field("plain", per_side=4, pitch_mm=155.0)
    model = demonstration_model(plain)
    iop, eop = model.interior.as_array(), model.exterior.as_array()
    given = plain.points + rng.normal(0, max(field_sd, 1e-9), plain.points.shape)
    field = TestField.build(plain.names, given, field_sd)
    calibrator = Calibrator(model.sensor, field, nominal_c=3.04)
    settings = AdjustmentSettings()
    common = CommonUnknowns(model.sensor, field, settings, exterior=exterior, offsets=True)
    results, truth = [], []
    for k in range(epochs):
        now = np.concatenate([iop, eop])
        now[:3] += np.array([2e-3, -4.5e-3, -3e-3]) * (1 - np.exp(-k / 25))
        now[10:13] += rng.normal(0, tremble_px * model.sensor.pixel_pitch / 3.04, 3)
        points = project(model.sensor, now[:10], now[10:], plain.points)
        points += rng.normal(0, NOISE, points.shape)
        rows = rng.permutation(len(plain))[: len(plain) - hidden]
        seen = Observations(rows, points[rows], np.full((len(rows), 2), NOISE))
        results.append(common.refine(seen, calibrator.adjust(seen)))
        truth.append(now)
    return results, np.array(truth)


@pytest.mark.parametrize("tremble_px", [0.0, 0.1])
def test_a_mount_that_trembles_has_true_standard_deviations(tremble_px):
    """Three running series of 60 epochs before a known field, the last 20 of each; c, x0, y0."""
    z, sds = [], []
    for seed in range(3):
        rng = np.random.default_rng([61, seed])
        results, truth = small_series(rng, "auto", tremble_px, 60, field_sd=0.0)
        assert all(r.ok for r in results)
        sd = np.array([r.sd[:3] for r in results])
        z.append((np.array([r.values[:3] for r in results]) - truth[:, :3])[40:] / sd[40:])
        sds.append(sd[-1, 1] / 0.00112)
    rms = np.sqrt(np.mean(np.square(z), axis=(0, 1)))
    assert rms == pytest.approx(np.ones(3), abs=0.6)  # what the epochs share is three draws
    if not tremble_px:
        assert np.median(sds) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize(("exterior", "tremble_px"), [("series", 0.0), ("auto", 0.05)])
def test_errors_are_as_large_as_stated(exterior, tremble_px):
    """A hundred running series before a field known to 0.03 mm; what all epochs share included."""
    z = []
    for seed in range(100):
        rng = np.random.default_rng([1000 + seed, 5])
        results, truth = small_series(rng, exterior, tremble_px, 25)
        z.append([(results[k].values - truth[k])[:3] / results[k].sd[:3] for k in (9, 18, 24)])
    # of 100 series a standard deviation is known to 7 %, of three epochs of each to little less
    rms = np.sqrt(np.mean(np.square(z), axis=(0, 1)))
    assert rms.min() > 0.9
    assert rms.max() < 1.1


def test_the_first_epochs_are_not_surer_than_they_are(scene):
    """With an uncertain field the offsets use up a first epoch; its sd is that of the epoch."""
    results, alone, _, _ = run(scene, 6, exterior="series", offsets=True)
    for together, apart in zip(results, alone, strict=True):
        assert (together.sd[:3] > 0.6 * apart.sd[:3]).all()


def held_bytes(value, seen=None) -> int:
    """Bytes of all arrays that an object holds."""
    seen = set() if seen is None else seen
    if id(value) in seen:
        return 0
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, (list, tuple, deque)):
        return sum(held_bytes(v, seen) for v in value)
    slots = getattr(type(value), "__slots__", ())
    inner = [*vars(value).values()] if hasattr(value, "__dict__") else []
    return sum(held_bytes(v, seen) for v in [*inner, *(getattr(value, s) for s in slots)])


def test_an_epoch_of_month_twelve_costs_what_one_of_the_first_day_does(scene, monkeypatch):
    """Operations and bytes held are counted, of 60 epochs early and after 100,000 like them.

    60 epochs instead of 240 are kept, and 40 kinds of epochs instead of 300.
    """
    monkeypatch.setattr(running_series, "_WINDOW", 60)
    monkeypatch.setattr(common_sums, "_MOST_PATTERNS", 40)
    sensor, field, epoch = scene
    calibrator = Calibrator(sensor, field, AdjustmentSettings(), nominal_c=3.04)
    common = CommonUnknowns(sensor, field, AdjustmentSettings(), exterior="auto", offsets=True)
    counted: Counter[str] = Counter()

    def count(module, name):
        real = getattr(module, name)

        def wrapper(first, *others):
            counted[name] += getattr(first, "size", 1)
            return real(first, *others)

        monkeypatch.setattr(module, name, wrapper)

    count(system, "normal_matrices")
    count(system, "cofactors")
    count(system, "right_hand_sides")
    count(common_sums, "inverse_of_determined")
    count(exterior, "estimate_movement")

    def work(epochs):
        counted.clear()
        for _ in range(epochs):
            observations, _ = epoch(40)
            assert common.refine(observations, calibrator.adjust(observations)).ok
        return dict(counted), held_bytes(common)

    work(80)  # more kinds of epochs than are kept apart
    early, memory = work(60)
    running = common._series
    age = 100_000 // running.epochs
    running.epochs *= age
    running._look_at += running.epochs - running.epochs // age
    running._solved *= age
    running._sums.epochs *= age
    for pattern in running._sums.patterns.values():
        pattern.epochs, pattern.weights = pattern.epochs * age, pattern.weights * age
    late, memory_late = work(60)
    assert running.epochs > 99_000
    assert memory_late == memory
    assert set(late) <= set(early)
    for name, size in late.items():
        assert size < 4 * early[name], name  # rounds of iteration differ; the epochs are 700 times
