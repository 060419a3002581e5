"""The network: targets in three dimensions from photographs, with a covariance that is true.

A self-calibrating bundle adjustment without control: interior orientation common to all
photographs, datum by inner constraints over the targets, scale by measured distances, gross errors
found by Baarda's data snooping in its two-dimensional form. A network that cannot carry the result
is refused with its reasons (`network_checks`).

Source: Luhmann, T. et al. (2014): Close-Range Photogrammetry and 3D Imaging, 2nd ed., sections
4.4 and 7.3; Baarda, W. (1968): A testing procedure for use in geodetic networks; Förstner, W.,
Wrobel, B. (2016): Photogrammetric Computer Vision, section 4.6.4 (test of a point).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    CameraModel,
    ExteriorOrientation,
    InteriorOrientation,
    Sensor,
)
from thermocald.photogrammetry.network import bundle as nb
from thermocald.photogrammetry.network.checks import refuse_before, refuse_narrow, refuse_weak
from thermocald.photogrammetry.network.covariance import covariance
from thermocald.photogrammetry.network.datum import Datum, Distance, bring_to_datum
from thermocald.photogrammetry.network.result import Network, Rejection, Station
from thermocald.photogrammetry.network.snooping import MIN_RAYS, Cleaned, snoop
from thermocald.photogrammetry.network.start import approximate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.photogrammetry.network.bundle import Bundle, ImageRays

__all__ = ["Distance", "Network", "Photo", "Rejection", "Station", "adjust_network"]


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """One photograph: its name and what was measured in it; targets are rows of the names."""

    name: str
    observations: Observations


def adjust_network(
    sensor: Sensor,
    photos: Sequence[Photo],
    names: Sequence[str],
    distances: Sequence[Distance],
    *,
    interior: InteriorOrientation | None = None,
    nominal: Array | None = None,
    free: Sequence[str] = IOP_NAMES,
    start: Network | None = None,
) -> Network:
    """Adjust a free network of photographs taken by one camera with unchanged focus.

    names: the m targets that the observations' rows count; distances: measured ones between
    targets, they give the scale; interior: approximate values, searched for if None; nominal:
    approximate coordinates (m, 3) mm, NaN where unknown; free: the interior parameters to be
    determined; start: an earlier result for the same photographs, whose orientation is begun with.
    Raises GeometryError where the network cannot carry it, with the reasons.
    """
    rays, left_out = _collect(photos, len(names), names)
    refuse_before(len(photos), rays, distances, names)
    free_rows = np.array([IOP_NAMES.index(name) for name in free], dtype=int)
    bundle, kept, used = (
        approximate(sensor, rays, len(names), interior, nominal, free_rows)
        if start is None
        else _resume(start, photos, names, rays)
    )
    for i in sorted(set(range(len(photos))) - set(kept)):
        left_out[photos[i].name] = "could not be oriented: too few targets in common with others"

    clean = snoop(sensor, bundle, used, free_rows)
    for i in sorted(set(range(len(kept))) - set(clean.photos.tolist())):
        left_out[photos[kept[i]].name] = (
            "contradicts the others: another focus, or a field that moved"
        )
    for t in np.setdiff1d(rays.target, clean.targets):
        left_out[names[int(t)]] = "fewer than three photographs agree on it"
    bundle, final = clean.bundle, clean.rays
    kept_photos = [photos[kept[int(i)]] for i in clean.photos]
    kept_names = tuple(names[int(t)] for t in clean.targets)

    refuse_narrow(_intersection_angles(bundle, final))
    v = nb.residuals(sensor, bundle, final)
    unknowns = len(free_rows) + 6 * len(kept_photos) + 3 * len(kept_names) - 7
    redundancy = 2 * len(final) - unknowns
    sigma0 = float(np.sqrt(np.sum(v * v) / max(redundancy, 1)))
    cofactors = covariance(sensor, bundle, final, free_rows, np.ones(len(final)))
    placed = bring_to_datum(
        bundle,
        cofactors.points * sigma0**2,
        distances,
        {name: i for i, name in enumerate(kept_names)},
        None if nominal is None else np.asarray(nominal, dtype=float)[clean.targets],
    )
    network = Network(
        names=kept_names,
        points=placed.bundle.points,
        covariance=placed.covariance,
        n_rays=np.bincount(final.target, minlength=len(kept_names)),
        angles=_intersection_angles(placed.bundle, final),
        camera=CameraModel(sensor, InteriorOrientation.from_array(bundle.interior)),
        interior_covariance=cofactors.interior * sigma0**2,
        free=tuple(free),
        stations=_stations(kept_photos, placed, cofactors.centres * sigma0**2, final),
        sigma0=sigma0,
        redundancy=redundancy,
        residuals=_residuals_px(sensor, bundle, final),
        rejected=_rejections([photos[i].name for i in kept], names, used, clean),
        unused=left_out,
        datum=placed.statement,
        sd_scale=placed.sd_scale,
    )
    refuse_weak(network, cofactors.weakest)
    return network


def _collect(
    photos: Sequence[Photo], m: int, names: Sequence[str]
) -> tuple[ImageRays, dict[str, str]]:
    """All rays of targets that enough photographs show, and what was left out."""
    photo, target, points, whitening = [], [], [], []
    for i, p in enumerate(photos):
        o = p.observations
        photo.append(np.full(len(o), i))
        target.append(np.asarray(o.targets, dtype=np.int64))
        points.append(o.points)
        C = np.zeros((len(o), 2, 2))
        C[:, 0, 0], C[:, 1, 1] = o.sigmas[:, 0] ** 2, o.sigmas[:, 1] ** 2
        if o.covariances is not None:
            C[:, 0, 1] = C[:, 1, 0] = o.covariances
        whitening.append(np.linalg.inv(np.linalg.cholesky(C)))
    rays = nb.ImageRays(
        np.concatenate(photo), np.concatenate(target), np.concatenate(points).astype(float),
        np.concatenate(whitening),
    )  # fmt: skip
    seen = np.bincount(rays.target, minlength=m)
    left_out = {
        names[int(t)]: "fewer than three photographs show it"
        for t in np.flatnonzero((seen > 0) & (seen < MIN_RAYS))
    }
    return rays.select(seen[rays.target] >= MIN_RAYS), left_out


def _resume(
    start: Network, photos: Sequence[Photo], names: Sequence[str], rays: ImageRays
) -> tuple[Bundle, list[int], ImageRays]:
    """The bundle of an earlier result, for the rays of its photographs and targets."""
    rows = {p.name: i for i, p in enumerate(photos)}
    kept = [rows[s.photo] for s in start.stations]
    number = np.full(len(photos), -1)
    number[kept] = np.arange(len(kept))
    points = np.full((len(names), 3), np.nan)
    index = {name: i for i, name in enumerate(names)}
    points[[index[name] for name in start.names]] = start.points
    used = rays.select((number[rays.photo] >= 0) & np.isfinite(points[rays.target, 0]))
    return (
        nb.Bundle(
            start.camera.interior.as_array(),
            np.array([s.exterior.rotation for s in start.stations]),
            np.array([s.exterior.centre for s in start.stations]),
            np.nan_to_num(points),
        ),
        kept,
        nb.ImageRays(number[used.photo], used.target, used.points, used.whitening),
    )


def _rejections(
    photos: Sequence[str], names: Sequence[str], rays: ImageRays, clean: Cleaned
) -> tuple[Rejection, ...]:
    """The rejected image points, by photograph and target."""
    found = [
        Rejection(
            photos[int(rays.photo[row])], names[int(rays.target[row])],
            float(clean.residuals[row]), float(clean.tests[row]),
        )
        for row in np.flatnonzero(clean.rejected)
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda r: (r.photo, r.target)))


def _stations(
    photos: Sequence[Photo], placed: Datum, cofactors: Array, rays: ImageRays
) -> tuple[Station, ...]:
    """The stations in their datum; cofactors (k, 3, 3) mm² of the centres before."""
    stations = []
    for i, photo in enumerate(photos):
        C = placed.scale**2 * placed.turn @ cofactors[i] @ placed.turn.T
        x, y, z = np.sqrt(np.diag(C)).tolist()
        bundle = placed.bundle
        exterior = ExteriorOrientation.from_rotation(bundle.rotations[i], bundle.centres[i])
        stations.append(Station(photo.name, exterior, int((rays.photo == i).sum()), (x, y, z)))
    return tuple(stations)


def _residuals_px(sensor: Sensor, bundle: Bundle, rays: ImageRays) -> tuple[Array, ...]:
    """Residuals per photograph, (n, 2) px each."""
    units = np.broadcast_to(np.eye(2), (len(rays), 2, 2))
    v = nb.residuals(sensor, bundle, nb.ImageRays(rays.photo, rays.target, rays.points, units))
    return tuple(v[rays.photo == i] for i in range(len(bundle.centres)))


def _intersection_angles(bundle: Bundle, rays: ImageRays) -> Array:
    """The largest angle between two rays of each target, (m,) rad."""
    d = bundle.centres[rays.photo] - bundle.points[rays.target]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    angles = np.zeros(len(bundle.points))
    for t in range(len(bundle.points)):
        mine = d[rays.target == t]
        angles[t] = np.arccos(np.clip((mine @ mine.T).min(), -1, 1)) if len(mine) > 1 else 0.0
    return angles
