"""Audit of the adjustments of image points: epoch, series, mount, photographs, online filter."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.audit_rows import Row, ratio
from thermocald.analysis.camera.photographs import calibrate_observations
from thermocald.analysis.online.filter import FieldErrors, OnlineFilter
from thermocald.analysis.online.observer import fit_approach
from thermocald.photogrammetry.camera.camera_model import (
    CameraSpec,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
    project,
    rotation,
)
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings, adjust
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.series.adjustment import adjust_series
from thermocald.photogrammetry.series.result import Exterior, SeriesAdjustment, SeriesSettings
from thermocald.physics.testfields import corner_field, demonstration_model

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

NOISE_PX = 0.04


class Scene:
    """A camera before a corner of 48 targets whose coordinates have errors of the stated size."""

    def __init__(
        self, rng: np.random.Generator, sigma_mm: float, noise_px: float = NOISE_PX,
        camera: str = "", depth: str = "corner",
    ):  # fmt: skip
        self.rng, self.noise = rng, noise_px
        plain = corner_field("plain", per_side=4, pitch_mm=150.0)
        model = demonstration_model(plain)
        self.sensor = model.sensor
        self.iop, self.eop = model.interior.as_array(), model.exterior.as_array()
        points = plain.points
        if camera:
            self.sensor, self.iop = _camera(*CAMERAS[camera])
            points = _filled(self.sensor, self.iop, self.eop, depth, rng)
        self.field = TestField.build(plain.names, points, sigma_mm)
        self.points = points + sigma_mm * rng.standard_normal(points.shape)

    def observe(self, iop: Array, eop: Array, gross: float = 0.0) -> Observations:
        seen = project(self.sensor, iop, eop, self.points)
        seen = seen + self.rng.normal(0, self.noise, seen.shape)
        wrong = self.rng.random(len(seen)) < gross
        seen[wrong] += self.rng.normal(0, 5.0, (int(wrong.sum()), 2))
        return Observations(np.arange(len(seen)), seen, np.full(seen.shape, NOISE_PX))

    def adjust(self, observations: Observations):
        return adjust(
            self.sensor, self.field, observations, InteriorOrientation.from_array(self.iop),
            ExteriorOrientation.from_array(self.eop),
        )  # fmt: skip


CAMERAS = {
    '1/4", 62°': (3280, 2464, 0.00112, 62.0, -0.04),
    "phone, 69°, fx/fy 1.003": (4000, 3000, 0.0014, 69.0, 0.03, 3e-3, 1e-3),
    '1", 79°': (5472, 3648, 0.0024, 79.0, -0.03),
    '1/4", 100°': (2592, 1944, 0.0014, 100.0, -0.03),
    '1/2.3", 120°': (4000, 3000, 0.00155, 120.0, -0.02),
}
"""Width and height px, pixel pitch mm, horizontal angle of view °, k1 of OpenCV; C1, C2."""

DEPTHS = ("corner", "sheet", "wall", "room")


def _camera(
    width: int, height: int, pitch: float, angle: float, k1: float, C1: float = 0.0, C2: float = 0.0
) -> tuple[Sensor, Array]:
    """Return a camera with this angle of view, its principal point slightly off the centre."""
    sensor = Sensor(width, height, pitch)
    c = 0.5 * width * pitch / np.tan(np.radians(0.5 * angle))
    return sensor, InteriorOrientation(
        c=c, x0=0.003 * width * pitch, y0=-0.004 * width * pitch, A1=k1 / c**2,
        A2=0.1 * abs(k1) / c**4, B1=1e-4 / c, B2=-2e-4 / c, C1=C1, C2=C2,
    ).as_array()  # fmt: skip


def _filled(sensor: Sensor, iop: Array, eop: Array, depth: str, rng: np.random.Generator) -> Array:
    """Return 48 targets (48, 3) mm that fill the image, at least 1 m away.

    They are on three walls that meet, on a bent sheet or an oblique wall, or anywhere in a room.
    """
    u, v = (
        a.ravel() for a in np.meshgrid(np.linspace(-0.88, 0.88, 8), np.linspace(-0.85, 0.85, 6))
    )
    x, y = 0.5 * sensor.pixel_pitch * np.stack([u * sensor.width, v * sensor.height]) / iop[0]
    third = np.cos((np.arctan2(y, x) - 0.5 * np.pi) % (2 * np.pi / 3) - np.pi / 3)
    away = (
        1000.0
        * {
            "corner": 1.0 / (1.0 + 1.4 * np.hypot(x, y) * third),
            "sheet": (1.0 - 0.25 * u**2) / (1.0 + 0.3 * x),
            "wall": 1.0 / (1.0 + 0.7 * x / np.abs(x).max()),
            "room": rng.uniform(1.0, 2.5, len(x)),
        }[depth]
    )
    rays = np.stack([x, y, -np.ones(len(x))], axis=1) * away[:, None]
    return eop[3:] + rays @ rotation(eop[:3]).T


def cameras(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit cameras of 62° to 120° before four fields each, in series of 3 to 1,000 epochs."""
    rows = []
    for camera in CAMERAS:
        off, change, level, refused, long = [], [], [], [], []
        for depth in DEPTHS:
            for _ in range(max(draws // 50, 1)):
                scene = Scene(rng, 0.01, camera=camera, depth=depth)
                long.append(_change(*_series(scene, 1000, 0.0, "series", tau=200.0)))
            for k in range(max(draws // 8, 1)):
                scene = Scene(rng, 0.01, camera=camera, depth=depth)
                alone = scene.adjust(scene.observe(scene.iop, scene.eop))
                if alone.ok:
                    error = alone.values - np.concatenate([scene.iop, scene.eop])
                    off.append((error / alone.sd)[[0, 1, 2, 13, 14, 15]])
                else:
                    refused.append(depth)
                found, truth = _series(scene, (3, 10, 30, 100)[k % 4], 0.0, "series")
                change.append(_change(found, truth))
                level.append(_level(found, truth))
        print(f"({camera}: {len(refused)} epochs refused, field {set(refused)})", file=sys.stderr)
        rows += [
            ratio("`replay`, daemon: an epoch", f"sd of c, x0, y0, X0, Y0, Z0; {camera}",
                  "noise, the field's coordinates", np.array(off)),
            ratio("`replay`, `study`: a series", f"sd of last − first; {camera}",
                  "noise of both epochs", np.array(change)),
            ratio("`replay`, `study`: a series", f"sd of last − first of 1,000; {camera}",
                  "noise of both epochs", np.array(long)),
            ratio("`replay`, `study`: a series", f"sd of the level; {camera}",
                  "EOP and field, common to all epochs", np.array(level)),
        ]  # fmt: skip
    return rows


def _change(found: SeriesAdjustment, truth: Array, first: int = 0, last: int = -1) -> Array:
    """Return error over sd (3,) of the change of c, x0, y0 between two epochs."""
    error = (found.values - truth)[:, :3]
    sd = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3])
    return np.asarray((error[last] - error[first]) / np.hypot(sd[first], sd[last]))


def _level(found: SeriesAdjustment, truth: Array) -> Array:
    """Return error over sd (3,) of the level of c, x0, y0."""
    error = (found.values - truth)[:, :3]
    return np.asarray(error.mean(axis=0) / np.sqrt(np.diag(found.level_covariance)[:3]))


def epoch(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit the adjustment of one epoch."""
    rows = []
    cases = (
        ("field 0.01 mm", 0.01, 0.0, 1.0),
        ("field 0.01 mm, 3 % gross errors", 0.01, 0.03, 1.0),
        ("noise twice the stated", 0.0, 0.0, 2.0),
    )
    for what, sigma, gross, factor in cases:
        off, sigma0 = [], []
        for _ in range(draws):
            scene = Scene(rng, sigma, factor * NOISE_PX)
            result = scene.adjust(scene.observe(scene.iop, scene.eop, gross))
            if result.ok:
                truth = np.concatenate([scene.iop, scene.eop])
                off.append(((result.values - truth) / result.sd)[[0, 1, 2, 13, 14, 15]])
                sigma0.append(result.sigma0)
        rows.append(ratio("`replay`, daemon: an epoch", f"sd of c, x0, y0, X0, Y0, Z0; {what}",
                          "noise, the field's coordinates", np.array(off)))  # fmt: skip
        if factor != 1.0:
            print(f"(sigma0 with the stated sigmas: {np.mean(sigma0):.2f})", file=sys.stderr)
    return rows


def _series(scene: Scene, epochs: int, tremble_px: float, exterior: Exterior, drift=1.0, tau=10.0):
    truth = np.tile(np.concatenate([scene.iop, scene.eop]), (epochs, 1))
    warm = drift * (1 - np.exp(-np.arange(epochs) / tau))
    truth[:, :3] += warm[:, None] * np.array([2e-3, -4.5e-3, 3e-3])
    per_px = scene.sensor.pixel_pitch / scene.iop[0]
    truth[:, 10:13] += tremble_px * per_px * scene.rng.standard_normal((epochs, 3))
    seen = [scene.observe(one[:10], one[10:]) for one in truth]
    result = adjust_series(
        scene.sensor, scene.field, seen, InteriorOrientation.from_array(scene.iop),
        ExteriorOrientation.from_array(scene.eop), SeriesSettings(exterior=exterior),
    )  # fmt: skip
    return result, truth


def series(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit a series with a still mount: differences between epochs, and their common level."""
    change, level = [], []
    for _ in range(draws):
        scene = Scene(rng, 0.01)
        found, truth = _series(scene, 24, 0.0, "series")
        change.append(_change(found, truth))
        level.append(_level(found, truth))
    strong = []
    for _ in range(max(draws // 10, 4)):
        scene = Scene(rng, 0.0, 0.5 * NOISE_PX)
        strong.append(_change(*_series(scene, 150, 0.0, "series", drift=4.0, tau=15.0)))
    return [
        ratio("`replay`, `study`: a series", "sd of last − first; warm-up by 16 px in 150 epochs",
              "noise of both epochs", np.array(strong)),
        ratio("`replay`, `study`: a series", "sd of last − first; c, x0, y0",
              "noise of both epochs", np.array(change)),
        ratio("`replay`, `study`: a series", "sd of the level; c, x0, y0",
              "EOP and field, common to all epochs", np.array(level)),
    ]  # fmt: skip


def mount(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit a trembling mount."""
    rows = []
    for tremble in (0.02, 0.1):
        off = []
        for _ in range(draws):
            scene = Scene(rng, 0.0)
            off.append(_change(*_series(scene, 40, tremble, "mount"), 10, 30))
        rows.append(ratio("`--exterior mount`", f"sd of a difference; c, x0, y0; {tremble} px",
                          "noise and movements of the mount", np.array(off)))  # fmt: skip
    return rows


def _noisy(
    scene: Scene, targets: int, factor: float, edge: float, epochs: int
) -> list[Observations]:
    """Draw epochs of some targets with `factor` times the stated noise, at corners `edge` times."""
    kept = scene.rng.choice(len(scene.field), targets, replace=False)
    half = 0.5 * np.array([scene.sensor.width - 1, scene.sensor.height - 1])
    out = []
    for _ in range(epochs):
        o = scene.observe(scene.iop, scene.eop)
        share = np.linalg.norm(o.points - half, axis=1) / np.linalg.norm(half)
        more = np.sqrt((factor * edge**share) ** 2 - 1.0)[:, None]
        o.points[:] += NOISE_PX * more * scene.rng.standard_normal(o.points.shape)
        out.append(o.select(np.isin(o.targets, kept)))
    return out


def noise(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit single epochs and series of few targets, with false statements of noise or field."""
    rows = []
    for what, targets, factor, edge, worse in (
        ("12 targets", 12, 1.0, 1.0, 1.0),
        ("24 targets, noise three times as stated", 24, 3.0, 1.0, 1.0),
        ("24 targets, corners three times noisier", 24, 1.0, 3.0, 1.0),
        ("24 targets, field ten times worse than stated", 24, 1.0, 1.0, 10.0),
        ("48 targets, field ten times worse than stated", 48, 1.0, 1.0, 10.0),
    ):  # fmt: skip
        off, refused, change, level, factors = [], 0, [], [], []
        for _ in range(draws // 2):
            scene = Scene(rng, 0.01)
            scene.points = scene.field.points + worse * (scene.points - scene.field.points)
            seen = _noisy(scene, targets, factor, edge, 24)
            alone = scene.adjust(seen[0])
            truth = np.concatenate([scene.iop, scene.eop])
            refused += not alone.ok
            if alone.ok:
                off.append(((alone.values - truth) / alone.sd)[:3])
            found = adjust_series(
                scene.sensor, scene.field, seen, InteriorOrientation.from_array(scene.iop),
                ExteriorOrientation.from_array(scene.eop), SeriesSettings(exterior="series"),
            )  # fmt: skip
            if found.ok.all():
                change.append(_change(found, truth))
                level.append(_level(found, truth))
                factors.append(found.field_ratio)
        field = f"field × {np.median(factors):.1f}"
        print(f"({what}: {refused} of {draws // 2} refused, {field})", file=sys.stderr)
        rows.append(ratio("`replay`, daemon: an epoch", f"sd of c, x0, y0; {what}",
                          "noise and field as the residuals show them", np.array(off)))  # fmt: skip
        rows.append(ratio("`replay`, `study`: a series", f"sd of last − first; {what}",
                          "noise of both epochs", np.array(change)))  # fmt: skip
        rows.append(ratio("`replay`, `study`: a series", f"sd of the level; {what}",
                          "EOP and field, as the offsets show it", np.array(level)))  # fmt: skip
    return rows


def calibrate(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit the calibration from four photographs of one field."""
    rows = []
    for what, sigma, few, gross_px in (
        ("field 0.0 mm", 0.0, 48, 0.0), ("field 0.05 mm", 0.05, 48, 0.0),
        ("16 targets, 8 % gross errors of 15 px", 0.0, 16, 15.0),
        ("48 targets, 8 % gross errors of 300 px", 0.0, 48, 300.0),
    ):  # fmt: skip
        off, failed = [], 0
        for _ in range(draws):
            scene = Scene(rng, sigma)
            found = calibrate_observations(
                ["a", "b", "c", "d"], photographs(scene, few, gross_px), {}, scene.field,
                CameraSpec("", scene.sensor, None, InteriorOrientation.from_array(scene.iop)),
                AdjustmentSettings(),
            )  # fmt: skip
            if found.interior is None or not found.estimated:
                failed += 1
                continue
            columns = [0, 1, 2, 5] if gross_px else [0, 1, 2]
            sd = np.sqrt(np.diag(found.covariance)[columns])
            off.append((found.interior.as_array() - scene.iop)[columns] / sd)
        if failed:
            print(f"({failed} of {draws} not calibrated)", file=sys.stderr)
        names = "c, x0, y0, A3" if gross_px else "c, x0, y0"
        rows.append(ratio("`calibrate`", f"sd of {names}; 4 photographs, {what}",
                          "noise, the field's coordinates", np.array(off)))  # fmt: skip
    return rows


def photographs(scene: Scene, few: int, gross_px: float) -> list[Observations]:
    """Draw image points of some targets at four stations, 8 % with gross errors (sd `gross_px`)."""
    kept = np.sort(scene.rng.choice(len(scene.field), few, replace=False))
    seen = []
    for turn in (0.0, 0.05, -0.05, 0.1):
        o = scene.observe(scene.iop, scene.eop + np.array([0, turn, 20 * turn, 400 * turn, 0, 0]))
        wrong = scene.rng.random(len(o)) < 0.08
        o.points[wrong] += scene.rng.normal(0, gross_px, (int(wrong.sum()), 2))
        seen.append(o.select(np.isin(o.targets, kept)))
    return seen


def online(draws: int, rng: np.random.Generator) -> list[Row]:
    """Audit the daemon's online filter: its estimate, its innovations, its drift."""
    rows = []
    for what, sigma, factor in (
        ("field 0.01 mm", 0.01, 1.0), ("field 0.05 mm", 0.05, 1.0),
        ("noise twice the stated", 0.0, 2.0),
    ):  # fmt: skip
        off, chi2 = [], []
        for _ in range(draws):
            scene = Scene(rng, sigma, factor * NOISE_PX)
            errors = FieldErrors(scene.sensor, scene.field)
            found = OnlineFilter(scene.sensor, errors.variances)
            for k in range(10):
                seen = scene.observe(scene.iop, scene.eop)
                result = scene.adjust(seen)
                one = found.update(result, 25.0, errors.split(result, seen))
                if k >= 4:
                    chi2.append(one.chi2 / one.dof)
            sd = np.sqrt(np.diag(found.covariance()))[:3]
            off.append((found.values() - np.concatenate([scene.iop, scene.eop]))[:3] / sd)
        rows.append(ratio("daemon, `status`: online", f"sd of c, x0, y0; {what}",
                          "noise, the field's coordinates", np.array(off)))  # fmt: skip
        rows.append(ratio("daemon: innovation", f"√(χ²/dof); {what}", "noise alone",
                          np.sqrt(chi2)))  # fmt: skip
    t = np.arange(40)[:, None] * 10.0
    course, now = 200.0 * 0.005 * np.exp((t[-1] - t) / 200.0), 0.005  # px, px/s at the last epoch
    truth = 200.0 * np.log(now / 1e-3)
    drift, ready = [], []
    for _ in range(draws):
        noise = rng.normal(0, 0.05, t.shape)
        speed, sd, ready_in, sd_ready_in, _ = fit_approach(
            t[:, 0], course + noise, np.full(t.shape, 0.05), 1e-3
        )
        drift.append((speed - now) / sd)
        ready.append((ready_in - truth) / sd_ready_in)
    rows.append(ratio("daemon, `status`: drift", "sd of px/min", "noise, the time constant",
                      np.array(drift)))  # fmt: skip
    rows.append(ratio("daemon, `status`: ready", "sd of min", "noise, the time constant",
                      np.array(ready)))  # fmt: skip
    return rows
