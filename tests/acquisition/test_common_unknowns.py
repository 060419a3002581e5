"""What epochs share: against the adjustment of the whole series, and against the truth."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import replace

import numpy as np
import pytest

from thermocald.acquisition import common_unknowns
from thermocald.acquisition.calibrator import Calibrator
from thermocald.acquisition.common_unknowns import CommonUnknowns
from thermocald.photogrammetry.camera.camera_model import (
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import Observations, TestField
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


@pytest.mark.parametrize("exterior", ["series", "per_epoch"])
def test_after_the_last_epoch_it_is_the_adjustment_of_the_whole_series(scene, exterior):
    sensor, field, _ = scene
    results, alone, _, seen = run(scene, 40, exterior=exterior, offsets=True)
    start = alone[-1]
    settings = SeriesSettings(exterior=exterior, target_noise=False, snooping_alpha=0.001)
    whole = adjust_series(
        sensor, field, seen,
        InteriorOrientation.from_array(start.values[:10]),
        ExteriorOrientation.from_array(start.values[10:]), settings,
    )  # fmt: skip
    last = results[-1]
    assert last.ok
    # the same but for what was rejected, and common unknowns that are a few epochs old
    assert np.abs(last.values - whole.values[-1])[:3] == pytest.approx(
        np.zeros(3), abs=0.15 * last.sd[:3].min()
    )
    assert last.sigma0 == pytest.approx(whole.sigma0[-1], rel=0.05)


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


def test_nothing_shared_leaves_the_epoch_as_it_is(scene):
    results, alone, _, _ = run(scene, 3, exterior="per_epoch", offsets=False)
    assert all(a is b for a, b in zip(results, alone, strict=True))


def test_priors_and_what_is_held_are_kept(scene):
    settings = AdjustmentSettings(
        free=("c", "x0", "y0"), priors={"c": (3.1, 1e-6), "Z0": (1000.0, 1e9)}
    )
    results, _, _, _ = run(scene, 4, settings, exterior="series", offsets=True)
    good = [r for r in results if r.interior is not None]
    for r in good:
        assert r.values[0] == pytest.approx(3.1, abs=1e-4)
        assert (r.values[3:10] == 0).all()


@pytest.mark.parametrize(("tremble_px", "field_sd"), [(0.0, 0.0), (0.1, 0.0), (0.1, 0.05)])
def test_a_mount_that_trembles_has_true_standard_deviations(tremble_px, field_sd):
    """Ten running series of 80 epochs, the last 40 of each about their mean; c, x0, y0."""
    plain = corner_field("plain", per_side=4, pitch_mm=150.0)
    model = demonstration_model(plain)
    iop, eop = model.interior.as_array(), model.exterior.as_array()
    z, sds = [], []
    for seed in range(10):
        rng = np.random.default_rng([61, seed])
        given = plain.points + rng.normal(0, max(field_sd, 1e-9), plain.points.shape)
        field = TestField.build(plain.names, given, field_sd)
        calibrator = Calibrator(model.sensor, field, nominal_c=3.04)
        common = CommonUnknowns(
            model.sensor, field, AdjustmentSettings(), exterior="auto", offsets=True
        )
        errors, stated = [], []
        for _ in range(80):
            pose = eop.copy()
            pose[:3] += rng.normal(0, tremble_px * model.sensor.pixel_pitch / 3.04, 3)
            points = project(model.sensor, iop, pose, plain.points)
            points += rng.normal(0, NOISE, points.shape)
            seen = Observations(np.arange(len(plain)), points, np.full((len(plain), 2), NOISE))
            result = common.refine(seen, calibrator.adjust(seen))
            assert result.ok
            errors.append(result.values[:3] - iop[:3])
            stated.append(result.sd[:3])
        late = np.array(errors)[40:]
        z.append((late - (late.mean(axis=0) if field_sd else 0.0)) / np.array(stated)[40:])
        sds.append(np.array(stated)[-1, 1] / model.sensor.pixel_pitch)
    rms = np.sqrt(np.mean(np.square(z), axis=(0, 1)))
    if field_sd:  # the field's errors are common to all epochs and part of the stated sds
        assert rms.max() < 1.1
    else:
        assert rms == pytest.approx(np.ones(3), abs=0.3 if tremble_px else 0.6)
    if not tremble_px:
        assert np.median(sds) < 0.15


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
    """Calls and sizes are counted, of 120 epochs after some hundred and after 100,000."""
    sensor, field, epoch = scene
    calibrator = Calibrator(sensor, field, AdjustmentSettings(), nominal_c=3.04)
    prepared = [(o, calibrator.adjust(o)) for o, _ in (epoch(40) for _ in range(40))]
    common = CommonUnknowns(sensor, field, AdjustmentSettings(), exterior="auto", offsets=True)
    counted: Counter[str] = Counter()

    def count(name):
        real = getattr(common_unknowns, name)

        def wrapper(first, *others):
            counted[name] += np.size(first) if isinstance(first, np.ndarray) else 1
            return real(first, *others)

        monkeypatch.setattr(common_unknowns, name, wrapper)

    for name in ("project", "scaled_inverse", "estimate_movement", "normal_matrices"):
        count(name)

    def work(epochs):
        counted.clear()
        for k in range(epochs):
            assert common.refine(*prepared[k % len(prepared)]).ok
        return dict(counted), held_bytes(common)

    work(260)  # the window of the mount is full
    early, memory = work(120)
    age = 100_000 // common.epochs
    common._H, common._h = common._H * age, common._h * age  # as many epochs like these
    common.epochs *= age
    common._looked *= age
    common._solved = replace(common._solved, epochs=common._solved.epochs * age)
    late, memory_late = work(120)
    assert common.epochs > 90_000
    assert memory_late == memory
    for name, size in late.items():
        assert size <= early[name], name
