"""The running series, compared with `replay` of the same epochs and with the truth; its cost."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from tests.marks import mostly_slow
from thermocald.acquisition.calibrator import Calibrator
from thermocald.analysis.online.running_series import RunningSeries
from thermocald.analysis.series.adjusted import table_of_series
from thermocald.analysis.series.epochs import calibrate_epochs
from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES, project
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.photogrammetry.series.result import SeriesSettings
from thermocald.physics.testfields import corner_field, demonstration_model
from thermocald.store.recording.head import CameraSpec, Head

NOISE = 0.04
MAIN = PARAMETER_NAMES[:3]


class Scene:
    """A camera that warms up before a corner with sds of `field_sd` mm; its mount may move."""

    def __init__(self, seed, *, field_sd=0.05, wrong=None, per_side=4, hidden=5, slow_px=0.0,
                 tremble_px=0.0, knock=None, defocus=0.0):  # fmt: skip
        self.rng = rng = np.random.default_rng([61, seed])
        self.plain = corner_field("plain", per_side=per_side, pitch_mm=620.0 / per_side)
        self.model = demonstration_model(self.plain)
        self.sensor = self.model.sensor
        error = field_sd if wrong is None else wrong
        given = self.plain.points + error * rng.normal(size=self.plain.points.shape)
        self.field = TestField.build(self.plain.names, given, field_sd)
        self.hidden, self.knock, self.defocus = hidden, knock, defocus
        per_px = self.sensor.pixel_pitch / 3.04
        self.tremble, self.slow = tremble_px * per_px, slow_px * per_px
        self.sway = np.zeros(3)

    def epoch(self, k: int, exterior=None) -> tuple[Epoch, np.ndarray]:
        """Return an epoch, at `exterior` if given, and its true values (16,)."""
        rng, warm = self.rng, 1 - np.exp(-k / 25)
        now = np.concatenate([self.model.interior.as_array(), self.model.exterior.as_array()])
        now[:3] += np.array([2e-3, -4.5e-3, -3e-3]) * warm
        self.sway = 0.95 * self.sway + rng.normal(0, self.slow * np.sqrt(1 - 0.95**2), 3)
        now[10:13] += self.sway + rng.normal(0, self.tremble, 3)
        if self.knock is not None and k >= self.knock:
            now[10] += 5e-4
        if exterior is not None:
            now[10:] = exterior
        points = project(self.sensor, now[:10], now[10:], self.plain.points)
        points += rng.normal(0, NOISE * (1 + self.defocus * warm), points.shape)
        rows = np.sort(rng.permutation(len(self.plain))[: len(self.plain) - self.hidden])
        rows = rows[self.sensor.contains(points[rows])]
        seen = Observations(rows, points[rows], np.full((len(rows), 2), NOISE))
        time = 1e9 + 10.0 * k
        return Epoch(k + 1, time, time, {"t": 20.0 + 10 * warm}, None, seen), now


def begun(scene, exterior="auto", settings=None, offsets=True):
    """Return a new calibrator and a new running series."""
    settings = settings or AdjustmentSettings()
    calibrator = Calibrator(scene.sensor, scene.field, settings, nominal_c=3.04)
    running = RunningSeries(scene.sensor, scene.field, settings, exterior=exterior, offsets=offsets)
    return calibrator, running


def take(scene, epochs, going=None, **options):
    """Return the running series, its results with columns, the single epochs, and the truth.

    going: the calibrator and the series of earlier epochs.
    """
    calibrator, running = going or begun(scene, **options)
    results, alone, truth = [], [], []
    for k in range(running.epochs, running.epochs + epochs):
        epoch, now = scene.epoch(k)
        alone.append(calibrator.calibrate(epoch))
        results.append(running.refine(alone[-1], epoch.observations))
        truth.append(now)
    return running, results, alone, np.array(truth)


def replayed(scene, alone):
    """Return the table of the same epochs from `replay`."""
    head = Head("replay", "M1", 10.0, CameraSpec("camera", scene.sensor, 3.04, None), {})
    calibrator = Calibrator(scene.sensor, scene.field, nominal_c=3.04)
    temperature = np.array([one.epoch.temperatures["t"] for one in alone])
    apart, seen = calibrate_epochs((one.epoch for one in alone), calibrator, temperature)
    settings = SeriesSettings.of(AdjustmentSettings(), "auto")
    grid = ObservationGrid.from_observations(scene.field, seen)
    return table_of_series(head, scene.field, apart, grid, settings)


@pytest.mark.slow
def test_growing_noise_costs_few_epochs_with_few_targets():
    """Neighbouring epochs show whether one of 15 targets is wrong or all are noisier.

    Of 34 epochs, 16 have a result of their own, and once had a live one.
    """
    scene = Scene(1, per_side=3, hidden=12, defocus=1.8, field_sd=0.01)
    _, results, alone, truth = take(scene, 34)
    table = replayed(scene, alone)
    ok = [r.ok for r, _ in results]
    assert sum(c.adjustment.ok for c in alone) < 17
    assert np.mean(ok) >= 0.95
    assert table.ok.all()
    live = np.array([(r.values[:3], r.sd[:3]) for r, _ in results if r.ok])
    for values, sds, now in (
        (live[:, 0], live[:, 1], truth[ok, :3]),
        (table.values[:, :3], table.sd[:, :3], truth[:, :3]),
    ):  # fmt: skip
        error = values - now
        z = (error - error.mean(axis=0)) / sds
        assert (np.sqrt((z**2).mean(axis=0)) < 1.25).all()
        assert np.abs(z).max() < 4.5


SCENES = {
    "still": {}, "trembling": {"tremble_px": 0.06}, "wandering": {"slow_px": 0.08},
    "knocked": {"knock": 24}, "badly surveyed": {"field_sd": 0.15, "wrong": 0.4},
}  # fmt: skip


@pytest.mark.parametrize("name", mostly_slow(SCENES, "knocked"))
def test_the_series_equals_replay_of_the_epochs_so_far(name):
    """After each common adjustment, values agree to 0.05 sd, and standard deviations to 2 %."""
    scene = Scene(3, **SCENES[name])
    _, results, alone, _ = take(scene, 34)
    for n in (1, 5, 20, 34):
        columns, table = results[n - 1][1], replayed(scene, alone[:n])
        assert table.ok[-1]
        for k, of in enumerate(MAIN):
            sd = table.sd[-1, k]
            assert abs(columns[f"series_{of}"] - table.values[-1, k]) < 0.05 * sd, of
            assert columns[f"sd_series_{of}"] == pytest.approx(sd, rel=0.02)
            assert columns[f"level_sd_{of}"] == pytest.approx(table.level_sd[k], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_every_epoch_has_a_result_with_true_standard_deviations(name):
    """Errors are from the mean of 60 epochs; the level has sds of its own."""
    z = []
    for seed in range(3):
        _, results, alone, truth = take(Scene(seed, **SCENES[name]), 60)
        assert all(c.adjustment.ok for c in alone)
        assert all(r.ok for r, _ in results)
        error = np.array([r.values[:3] for r, _ in results]) - truth[:, :3]
        z.append((error - error.mean(axis=0)) / [r.sd[:3] for r, _ in results])
        share = np.mean([len(r.rejected) / r.n_observations for r, _ in results])
    # in the last scene no more is rejected than by `replay`, or by chance
    replays = replayed(Scene(seed, **SCENES[name]), alone).adjustment
    assert share < max(1.2 * replays.rejected.sum() / replays.observed.sum(), 1e-3)
    rms = np.sqrt(np.mean(np.square(z), axis=(0, 1)))
    assert rms == pytest.approx(np.ones(3), abs=0.15)


def test_the_first_epochs_have_the_stated_noise():
    """The unknown errors of the field could absorb all residuals of one epoch."""
    for field_sd, wrong in ((0.02, 0.0), (2.0, 0.4), (0.05, 0.05), (0.002, 0.002)):
        _, results, alone, _ = take(Scene(4, field_sd=field_sd, wrong=wrong, hidden=0), 3)
        for (result, _), single in zip(results, alone, strict=True):
            assert 0.75 < result.sigma0 < 1.25
            assert result.sd[1] < 1.3 * single.adjustment.sd[1]
            assert len(result.rejected) <= 1
        sds = [r.sd[1] for r, _ in results]
        assert sds[0] == pytest.approx(sds[1], rel=0.3)


@pytest.fixture(scope="module")
def still():
    """Return a scene, its running series after 12 epochs and 27, the results, and the epochs."""
    scene = Scene(5)
    going = begun(scene)
    running, first, singles, _ = take(scene, 12, going)
    early = running.report()["orientation"]
    _, later, others, _ = take(scene, 15, going)
    return scene, running, early, first + later, singles + others


@pytest.fixture
def going_on(still):
    """Return a copy of the scene, and of its running series with a calibrator that starts anew."""
    scene, running = deepcopy(still[:2])
    return scene, (Calibrator(scene.sensor, scene.field, nominal_c=3.04), running)


def test_the_orientation_follows_the_data_and_is_reported(still):
    _, running, early, results, _ = still
    assert "until 20 good epochs show whether the camera stands still; 12 so far" in early
    assert "mount_px" not in results[10][1]
    assert results[-1][1]["mount_px"] == 0.0
    report = running.report()["orientation"]
    assert report == "the camera stands still: one orientation for 27 epochs"
    running, results, _, _ = take(Scene(5, tremble_px=0.2), 21)
    assert results[-1][1]["mount_px"] > 0.05
    assert "the mount moves by 0." in running.report()["orientation"]


def test_the_series_begins_again_after_the_camera_was_moved(going_on):
    scene, (calibrator, running) = going_on
    away = scene.model.exterior.as_array().copy()
    away[[1, 3]] += 0.2, 250.0
    begun_again = []
    for k in range(27, 39):
        epoch, now = scene.epoch(k, away)
        result, columns = running.refine(calibrator.calibrate(epoch), epoch.observations)
        assert result.ok
        assert abs(result.values[0] - now[0]) < 0.02
        begun_again.append("series_restarted" in columns)
    assert begun_again == [False, True] + [False] * 10
    assert "begun again after epoch" in running.report()["orientation"]


def test_a_series_that_contradicts_five_epochs_begins_again_and_they_keep_their_results(going_on):
    """The fifth epoch once raised an IndexError."""
    scene, (calibrator, running) = going_on
    adjusted = running._adjust_newest

    def contradicted(alone):
        own, whole = adjusted(alone)
        return own, replace(whole, status="global_test")

    running._adjust_newest = contradicted
    epochs = [scene.epoch(k)[0] for k in range(27, 33)]
    results = [running.refine(calibrator.calibrate(e), e.observations) for e in epochs]
    assert all(result.ok for result, _ in results)
    assert ["series_restarted" in columns for _, columns in results] == [False] * 4 + [True, False]


def test_remembered_epochs_restore_the_series(still):
    scene, _, _, results, alone = still
    _, again = begun(scene)
    for calibrated, (result, _) in zip(alone[:22], results, strict=False):
        again.remember(calibrated, calibrated.epoch.observations, result.values)
    for calibrated, (whole, columns) in zip(alone[22:], results[22:], strict=True):
        result, after = again.refine(calibrated, calibrated.epoch.observations)
        assert (np.abs(result.values - whole.values)[:3] < 0.1 * whole.sd[:3]).all()
        for name in MAIN:
            apart = after[f"series_{name}"] - columns[f"series_{name}"]
            sds = columns[f"sd_series_{name}"], columns[f"level_sd_{name}"]
            assert abs(apart) < 0.1 * np.hypot(*sds)


@pytest.mark.slow
def test_gross_errors_in_most_epochs_are_rejected():
    scene = Scene(8, hidden=8)
    calibrator, running = begun(scene)
    for k in range(24):
        epoch, _ = scene.epoch(k)
        points = epoch.observations.points.copy()
        points[: 3 if k % 3 else 0] += 20.0
        seen = replace(epoch.observations, points=points)
        result, _ = running.refine(calibrator.calibrate(replace(epoch, observations=seen)), seen)
        assert result.ok
        if k % 3:
            assert set(seen.targets[:3]) <= set(result.rejected)


def test_a_clock_that_is_set_back_is_harmless(going_on):
    """It is set back by two hours, and to the first instant at the end."""
    scene, (calibrator, running) = going_on
    for k in range(27, 32):
        epoch, _ = scene.epoch(k)
        back = 1e9 if k == 31 else epoch.frame_time - 7200.0
        epoch = replace(epoch, frame_time=back, temperature_time=back)
        result, columns = running.refine(calibrator.calibrate(epoch), epoch.observations)
        assert result.ok
        assert np.isfinite(result.values).all()
    assert columns["series_epochs"] == 32


def test_without_common_unknowns_epochs_are_unchanged():
    _, results, alone, _ = take(Scene(9), 3, exterior="per_epoch", offsets=False)
    assert all(r is c.adjustment and not x for (r, x), c in zip(results, alone, strict=True))


def test_priors_and_held_parameters_are_kept():
    settings = AdjustmentSettings(
        free=("c", "x0", "y0"), priors={"c": (3.1, 1e-6), "Z0": (1000.0, 1e9)}
    )
    _, results, _, _ = take(Scene(10), 4, settings=settings)
    for result, _ in results:
        assert result.values[0] == pytest.approx(3.1, abs=1e-4)
        assert (result.values[3:10] == 0).all()
