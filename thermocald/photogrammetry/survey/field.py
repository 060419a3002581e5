"""What a survey knows of its field on the way: where targets must be, how large they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.field.planes import target_normals
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.photogrammetry.targets.outline import local_maps

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.network.result import Network

__all__ = [
    "expected_field",
    "field_of_codes",
    "sheet_labels",
    "sheet_normals",
    "surveyed_field",
]

_ONE_SIZE = 0.15
_NEIGHBOURS = 8
_SAME_SHEET_COSINE = 0.97  # between the normals of neighbours on one sheet, which may be bent
_SAME_SHEET_STEP = 0.1  # of their distance: how far one may lie off the other's plane


def sheet_labels(points: Array) -> NDArray[np.int64]:
    """The sheet (n,) that each target at points (n, 3) mm belongs to, -1 for none.

    Sheets grow from neighbour to neighbour, so one may be bent, and two may meet in a corner.
    """
    normals = target_normals(points)
    labels = np.full(len(points), -1)
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = np.argsort(distance, axis=1)[:, 1 : _NEIGHBOURS + 1]
    step = np.abs(np.einsum("njk,nk->nj", points[near] - points[:, None], normals))
    alike = np.abs(np.einsum("njk,nk->nj", normals[near], normals)) > _SAME_SHEET_COSINE
    linked = alike & (step < _SAME_SHEET_STEP * np.take_along_axis(distance, near, axis=1))
    for first in range(len(points)):
        if labels[first] >= 0 or not np.isfinite(normals[first, 0]):
            continue
        labels[first] = labels.max() + 1
        waiting = [first]
        while waiting:
            row = waiting.pop()
            for other in near[row, linked[row]]:
                if labels[other] < 0:
                    labels[other] = labels[first]
                    waiting.append(int(other))
    # what has found no plane of its own belongs to its nearest neighbour's, if it lies in it
    placed = labels >= 0
    for lost in np.flatnonzero(~placed) if placed.any() else ():
        nearest = int(np.argmin(np.where(placed, distance[lost], np.inf)))
        off = abs(float((points[lost] - points[nearest]) @ normals[nearest]))
        if off < _SAME_SHEET_STEP * distance[lost, nearest]:
            labels[lost] = labels[nearest]
    return labels


def sheet_normals(points: Array, labels: NDArray[np.int64]) -> Array:
    """Unit normals (n, 3), of either sign, of targets by their nearest on the same sheet; NaN for
    those on none.
    """
    normals = np.full((len(points), 3), np.nan)
    for label in np.unique(labels[labels >= 0]):
        rows = np.flatnonzero(labels == label)
        if len(rows) < 4:
            continue
        whole = np.linalg.svd(points[rows] - points[rows].mean(axis=0))[2][2]
        for row in rows:
            order = np.argsort(np.linalg.norm(points[rows] - points[row], axis=1))
            near = points[rows[order[: _NEIGHBOURS + 1]]]
            _, size, axes = np.linalg.svd(near - near.mean(axis=0))
            # a single line of targets does not say how the paper is turned about it
            normals[row] = axes[2] if size[1] > 0.1 * size[0] else whole
    return normals


def expected_field(network: Network, nominal: TestField, *, trusted_only: bool) -> TestField:
    """The nominal field where the network has put it: surveyed coordinates, and for all others the
    nominal ones, moved as their surveyed neighbours were.

    trusted_only leaves out what an earlier pass should have found and did not.
    """
    rows = np.array([nominal.index[name] for name in network.names])
    points = nominal.points.copy()
    others = np.setdiff1d(np.arange(len(nominal)), rows)
    if len(others):
        points[others] += _neighbours_shift(
            nominal.points[rows], network.points - nominal.points[rows], nominal.points[others]
        )
    points[rows] = network.points
    moved = TestField.build(
        nominal.names, points, nominal.sigmas, nominal.diameters, nominal.kinds, nominal.codes
    )
    return moved.subset(np.sort(rows)) if trusted_only else moved


def _neighbours_shift(known: Array, shifts: Array, wanted: Array) -> Array:
    """The shifts (n, 3) mm at points between known ones: a local plane through the nearest.

    Weighted by the inverse square of the distance, so that a fold in the paper stays one.
    """
    result = np.empty((len(wanted), 3))
    for i, x in enumerate(wanted):
        d = np.linalg.norm(known - x, axis=1)
        near = np.argsort(d)[:12]
        weight = 1.0 / (d[near] + 1e-3 * d[near].max()) ** 2
        A = np.column_stack([np.ones(len(near)), known[near] - x])
        # the ridge keeps slopes that the neighbours do not show (across a plane) at zero
        AtW = A.T * weight
        ridge = 1e-3 * np.trace(AtW @ A) / 4 * np.diag([0.0, 1, 1, 1])
        result[i] = np.linalg.solve(AtW @ A + ridge, AtW @ shifts[near])[0]
    return result


def field_of_codes(
    network: Network, codes: Mapping[str, str], radii: Mapping[tuple[str, str], float]
) -> TestField:
    """The coded targets of a network as a field.

    codes: by target; radii: semi-major axes px by photograph and target, from which the diameters
    are found: what a disc of 1 mm would measure there, lying as its neighbours do.
    """
    normals = sheet_normals(network.points, sheet_labels(network.points))
    ratios: dict[str, list[float]] = {name: [] for name in network.names}
    interior = network.camera.interior.as_array()
    for s in network.stations:
        unit = local_maps(
            network.camera.sensor, interior, s.exterior.as_array(), network.points, normals,
            np.full(len(network.names), 0.5),
        )  # fmt: skip
        known = np.asarray(np.isfinite(unit.linear).all(axis=(1, 2)), dtype=bool)
        for i, name in enumerate(network.names):
            if (s.photo, name) in radii and known[i]:
                axis = float(np.linalg.svd(unit.linear[i], compute_uv=False)[0])
                ratios[name].append(radii[s.photo, name] / axis)
    diameters = np.array([np.median(r) if r else np.nan for r in ratios.values()])
    together = float(np.nanmedian(diameters)) if np.isfinite(diameters).any() else float("nan")
    # one size for all where all agree, which is as they are printed
    if np.nanmax(np.abs(diameters / together - 1), initial=0.0) < _ONE_SIZE:
        diameters[:] = together
    return TestField.build(
        network.names, network.points, network.sigmas, diameters,
        codes=[codes[name] for name in network.names],
    )  # fmt: skip


def surveyed_field(network: Network, template: TestField) -> TestField:
    """The field of the network's targets: coordinates and sigmas surveyed, the rest as it was."""
    order = np.argsort([template.index[name] for name in network.names])
    rows = [template.index[network.names[i]] for i in order]
    part = template.subset(rows)
    return TestField.build(
        part.names, network.points[order], network.sigmas[order], part.diameters, part.kinds,
        part.codes,
    )  # fmt: skip
