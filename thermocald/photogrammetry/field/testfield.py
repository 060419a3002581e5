"""The test field: its targets with their standard deviations, image observations, and planes.

A camera that replays observations instead of images gives a Frame whose metadata has, under
`observations`, {"target": [name …], "x": [px …], "y": […], "sx": […], "sy": […]} and, if known,
"sxy" px². Targets are given by name, not by row, because the receiver has a test field of its own.

A test field's file states neither its boards nor its targets' normals. We search for the planes
with the most targets, with a tolerance from the field's spacing and the errors of its coordinates.
Groups far apart in one plane are different boards; boards that touch in one plane count as one. A
target's normal is that of the plane through its nearest neighbours on the same board, so that a
board may be slightly bent. Four targets in a parallelogram are a plate with a normal of its own. A
target on no board and no plate has no normal; its eccentricity cannot be computed and is neglected.

Source: planes are found one after the other as by Fischler, Bolles (1981), Comm. ACM 24, 381-395
(RANSAC), but with targets as seeds instead of random samples.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import TestFieldError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array


KINDS = ("circle", "marker_corner", "chess_corner")


@dataclass(frozen=True, eq=False, repr=False)
class TestField:
    """A test field's targets: names, coordinates with standard deviations, and appearance.

    names: n unique strings; points (n, 3) mm; sigmas (n, 3) mm; diameters (n,) mm, NaN for targets
    without one; kinds, codes: n strings as defined in CONVENTIONS §3; a code may be empty; scale
    (n, 3) mm: the part of the sigmas that is due to the field's scale, with signs, or None.
    """

    __test__ = False  # pytest would collect a class of this name

    names: tuple[str, ...]
    points: Array
    sigmas: Array
    diameters: Array
    kinds: tuple[str, ...]
    codes: tuple[str, ...]
    scale: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = (self.points.shape, self.sigmas.shape, self.diameters.shape)
        if shapes != ((n, 3), (n, 3), (n,)) or len(self.kinds) != n or len(self.codes) != n:
            raise TestFieldError(f"a test field of {n} targets has columns of shapes {shapes}")
        if len(set(self.names)) != n:
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise TestFieldError(
                f"{twice!r} is given twice; each target or control point needs its own name"
            )
        first: dict[str, str] = {}
        for name, code in zip(self.names, self.codes, strict=True):
            if code and (other := first.setdefault(code, name)) != name:
                raise TestFieldError(
                    f"code {code!r} is duplicated in the test field, at targets {other!r} and "
                    f"{name!r}"
                )
        for array in (self.points, self.sigmas, self.diameters):
            array.setflags(write=False)

    def __repr__(self) -> str:
        return f"<TestField: {len(self)} targets>"

    @classmethod
    def build(
        cls,
        names: Sequence[str],
        points: ArrayLike,
        sigmas: ArrayLike = 0.0,
        diameters: ArrayLike = np.nan,
        kinds: Sequence[str] | str = "circle",
        codes: Sequence[str] | str = "",
    ) -> TestField:
        """Build a test field from columns; a scalar holds for all targets.

        Raises TestFieldError for columns of another length, and for what is no number.
        """
        n = len(names)
        try:
            columns = (
                np.array(points, dtype=float).reshape(n, 3),
                np.array(np.broadcast_to(np.asarray(sigmas, dtype=float), (n, 3))),
                np.array(np.broadcast_to(np.asarray(diameters, dtype=float), (n,))),
            )
        except (TypeError, ValueError):
            raise TestFieldError(
                f"{n} names: points and sigmas must be numbers ({n}, 3), diameters ({n},), or one "
                "for all"
            ) from None
        if not np.isfinite(columns[0]).all() or not (columns[1] >= 0.0).all():
            raise TestFieldError("points must be finite numbers, and sigmas 0 or above")
        return cls(
            tuple(names),
            *columns,
            (kinds,) * n if isinstance(kinds, str) else tuple(kinds),
            (codes,) * n if isinstance(codes, str) else tuple(codes),
        )

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def index(self) -> dict[str, int]:
        """The row of each target by its name."""
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def shape_sigmas(self) -> Array:
        """Standard deviations (n, 3) mm without the scale's: it does not affect a camera."""
        scale = 0.0 if self.scale is None else self.scale
        return np.sqrt(np.maximum(self.sigmas**2 - np.square(scale), 0.0))

    @cached_property
    def circles(self) -> NDArray[np.bool_]:
        """Which targets (n,) are circles."""
        return np.array([kind == "circle" for kind in self.kinds], dtype=bool)

    @cached_property
    def groups(self) -> NDArray[np.int64]:
        """Group label (n,) of each target: the corners of one marker have common errors.

        Corners are grouped by their code without the corner number, or else by their name up to
        its last dot.
        """
        labels: dict[str, int] = {}
        out = np.empty(len(self), dtype=np.int64)
        for i, (name, kind, code) in enumerate(
            zip(self.names, self.kinds, self.codes, strict=True)
        ):
            key = name
            if kind == "marker_corner":
                key = code.rpartition(":")[0] if code.count(":") > 1 else name.rpartition(".")[0]
            out[i] = labels.setdefault(key or name, len(labels))
        return out

    def subset(self, rows: ArrayLike) -> TestField:
        """Return the test field of some rows (indices)."""
        r = np.asarray(rows, dtype=int)
        names, kinds, codes = (
            tuple(column[i] for i in r) for column in (self.names, self.kinds, self.codes)
        )
        scale = None if self.scale is None else self.scale[r]
        return TestField(
            names, self.points[r], self.sigmas[r], self.diameters[r], kinds, codes, scale
        )


def same_targets(one: TestField, other: TestField) -> bool:
    """Return whether two test fields have the same targets at the same places."""
    return one.names == other.names and np.array_equal(one.points, other.points)


@dataclass(frozen=True, slots=True)
class Distance:
    """A measured distance between two targets, with its standard deviation, mm."""

    a: str
    b: str
    length: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The observed image points of one epoch.

    targets: n unique rows of the test field; points (n, 2) px; sigmas (n, 2) px; covariances (n,)
    px², between x and y, None if unknown; quality: further values per target, (n,) each, by name,
    such as `blur` px.
    """

    targets: NDArray[np.int64]
    points: Array
    sigmas: Array
    covariances: Array | None = None
    quality: dict[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.targets)
        if self.points.shape != (n, 2) or self.sigmas.shape != (n, 2):
            raise ValueError(
                f"{n} targets, image points {self.points.shape}, sigmas {self.sigmas.shape}"
            )

    def __len__(self) -> int:
        return len(self.targets)

    def select(self, keep: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Observations:
        """Return some of the observations, by mask, rows or slice."""
        return Observations(
            self.targets[keep],
            self.points[keep],
            self.sigmas[keep],
            None if self.covariances is None else self.covariances[keep],
            {name: values[keep] for name, values in self.quality.items()},
        )

    @classmethod
    def build(
        cls,
        rows: NDArray[np.int64],
        points: Array,
        covariances: Array,
        quality: Mapping[str, Array],
    ) -> Observations:
        """Build observations from covariances (n, 2, 2) px², in the order of the test field."""
        built = cls(
            rows,
            points,
            np.sqrt(np.stack([covariances[:, 0, 0], covariances[:, 1, 1]], axis=-1)),
            covariances[:, 0, 1],
            dict(quality),
        )
        return built.select(np.argsort(rows, kind="stable"))

    @classmethod
    def none(cls) -> Observations:
        """Return empty observations, with empty covariances."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))

    def joined(self, other: Observations) -> Observations:
        """Return these observations and others of the same frame, in the order of the test field.

        Both must be in this order and have covariances, and no target may be in both. A quality
        that only one of them has is NaN for the other.
        """
        parts = self, other
        names = dict.fromkeys([*other.quality, *self.quality])
        both = Observations(
            np.concatenate([p.targets for p in parts]),
            np.concatenate([p.points for p in parts]),
            np.concatenate([p.sigmas for p in parts]),
            np.concatenate([p.covariances for p in parts if p.covariances is not None]),
            {
                k: np.concatenate([p.quality.get(k, np.full(len(p), np.nan)) for p in parts])
                for k in names
            },
        )
        return both.select(np.argsort(both.targets, kind="stable"))


def observations_to_lists(seen: Observations, field: TestField) -> dict[str, Any]:
    """Return observations as lists for JSON, by target name."""
    columns = dict(zip(("x", "y", "sx", "sy"), (*seen.points.T, *seen.sigmas.T), strict=True))
    if seen.covariances is not None:
        columns["sxy"] = seen.covariances
    names = [field.names[row] for row in seen.targets.tolist()]
    return {"target": names, **{name: values.tolist() for name, values in columns.items()}}


def observations_from_lists(lists: Mapping[str, Any], field: TestField) -> Observations:
    """Invert `observations_to_lists`.

    Raises TestFieldError for a target that is not in the field, and for lists that do not match.
    """
    try:
        names = list(lists["target"])
        rows = [field.index.get(name, -1) for name in names]
        points, sigmas = (
            np.array([lists[x], lists[y]], dtype=float).T.reshape(len(rows), 2)
            for x, y in (("x", "y"), ("sx", "sy"))
        )
        covariances = None
        if "sxy" in lists:
            covariances = np.array(lists["sxy"], dtype=float).reshape(len(rows))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise TestFieldError(
            "observations need the lists target, x, y, sx and sy, with an entry for each target"
        ) from error
    if -1 in rows:
        raise TestFieldError(
            f"target {names[rows.index(-1)]!r} was measured but is not in the test field; is it "
            "the right field?"
        )
    return Observations(np.array(rows, dtype=np.int64), points, sigmas, covariances)


ELSEWHERE = 0.0025  # of the principal distance, if the camera is adjusted
FAR_ELSEWHERE = 0.01  # if it is only approximate, with larger errors in the image's corners
_UNUSUAL = 10.0  # times the median offset of all targets


def find_misplaced(offsets: Array, c_px: float, least: float = ELSEWHERE) -> NDArray[np.bool_]:
    """Return which targets (T,) are not where the test field has them.

    Two targets with exchanged names affect all residuals of an adjustment, and their partial
    derivatives are those of other points. offsets (T, 2) px: observed minus predicted, NaN for
    targets not observed; c_px: principal distance, px; least: smallest offset, as a share of it.
    """
    size = np.hypot(*np.asarray(offsets).T)
    observed = size[np.isfinite(size)]
    usual = float(np.median(observed)) if len(observed) else 0.0
    return np.asarray(size > max(least * c_px, _UNUSUAL * usual))


FEWEST_ON_A_SHEET = 6
"""Fewest targets of a board: three are always in a plane, five sometimes by chance."""

_SEED = 12  # nearest targets, for a first plane
_FLATNESS = 0.05  # of the distance between neighbours
_CREASE = 0.01  # of the distance between neighbours; farther out it may be another board's
_ITERATIONS = 20
_EXCHANGES = 5
_SIGMAS = 4.0  # tolerance, in standard deviations of the coordinates
_APART = 2.5  # times the distance between neighbours; farther is another board
_AROUND = 0.5  # share of a target's nearest that are on the same board, at least
_SEEDS = 60
_LOCAL = 8  # nearest targets on a board, for a normal
_PLATE = 4  # targets of a small plate, or at the rim of a board
_SKEW = 0.1  # of the spacing, by which the targets of a plate may miss a parallelogram
_LOOSE = 0.03  # flatness of a target and its nearest, as a share of the spacing, without a board
_COMPACT = 1.6  # for that, the largest ratio of their distances


@lru_cache(maxsize=16)
def field_normals(testfield: TestField) -> Array:
    """Return the `target_normals` (n, 3) of a field's circles; NaN for other targets."""
    circles = testfield.circles
    normals = np.full((len(testfield), 3), np.nan)
    # Marker corners are on the sheets too, and help if circles are few.
    normals[circles] = target_normals(testfield.points)[circles]
    normals.setflags(write=False)
    return normals


def target_normals(points: Array) -> Array:
    """Return unit normals (n, 3), of either sign, of targets at (n, 3) mm; NaN without a plane."""
    if len(points) < _PLATE:
        return np.full((len(points), 3), np.nan)
    near, _ = _neighbours(points)
    reach = np.linalg.norm(points[near[:, :_PLATE]] - points[:, None], axis=2)
    spacing = float(np.median(reach[:, 1]))
    labels = _sheets(points, 0.0)
    normals = sheet_normals(points, labels, _LOCAL)
    # in a corner, a plate and the nearest targets of other ones may pass for a small board
    small = np.isnan(normals[:, 0]) | (np.bincount(labels + 1)[labels + 1] <= 2 * _PLATE)
    for plate in _plates(points, near, small, _SKEW * spacing):
        normals[plate] = plane_fit(points[plate])[1][2]
    for row in np.flatnonzero(np.isnan(normals[:, 0])):
        local = points[near[row, :_PLATE]]
        spread = local - local.mean(axis=0)
        _, size, axes = np.linalg.svd(spread)
        if (
            reach[row, -1] < _COMPACT * reach[row, 1]
            and size[1] > 0.1 * size[0]
            and np.abs(spread @ axes[2]).max() < _LOOSE * spacing
        ):
            normals[row] = axes[2]
    return normals


def _plates(
    points: Array, near: NDArray[np.int64], loose: NDArray[np.bool_], tolerance: float
) -> list[list[int]]:
    """Return the rows of plates: four targets each in a parallelogram, among the loose ones (n,).

    near (n, k): each target and its nearest; tolerance: of the fourth corner, mm. A target's plate
    is the smallest parallelogram at whose corner it is. Where two plates meet at an edge, their
    inner targets may form a smaller one across it, but the outer ones cannot; so the larger of two
    plates with a common target is the true one.
    """
    found: list[tuple[float, int, list[int]]] = []
    for row in np.flatnonzero(loose).tolist():
        around = near[row, 1:][loose[near[row, 1:]]]
        for a, b in combinations(around[:_PLATE].tolist(), 2):
            u, v = points[a] - points[row], points[b] - points[row]
            size = float(u @ u + v @ v)
            off = np.linalg.norm(points[around] - (points[row] + u + v), axis=1)
            in_a_row = np.linalg.norm(np.cross(u, v)) < 0.1 * size
            if off.min() < tolerance and not in_a_row:
                found.append((size, row, [row, a, b, int(around[off.argmin()])]))
    smallest = {row: (size, plate) for size, row, plate in sorted(found, reverse=True)}
    plates: list[list[int]] = []
    for _, plate in sorted(smallest.values(), reverse=True):
        if not any(row in plate for other in plates for row in other):
            plates.append(plate)
    return plates


def sheet_normals(points: Array, labels: NDArray[np.int64], nearest: int) -> Array:
    """Return unit normals (n, 3), of either sign, of targets.

    A normal is that of the plane through the `nearest` targets on the same sheet, the target
    itself included. NaN for targets on no sheet (label -1), or on a sheet that is a single row,
    about which its board could be turned.
    """
    normals = np.full((len(points), 3), np.nan)
    for label in np.unique(labels[labels >= 0]):
        rows = np.flatnonzero(labels == label)
        if len(rows) < _PLATE:
            continue
        centre, (_, across, whole), _ = plane_fit(points[rows])
        width = np.ptp((points[rows] - centre) @ across)
        for row in rows:
            away = np.linalg.norm(points[rows] - points[row], axis=1)
            order = np.argsort(away, kind="stable")[:nearest]
            near = points[rows[order]]
            _, size, axes = np.linalg.svd(near - near.mean(axis=0))
            if size[1] > 0.1 * size[0]:
                normals[row] = axes[2]
            elif width > 0.5 * away[order[1]]:
                normals[row] = whole
    return normals


def plane_fit(points: ArrayLike, tolerance: float = 0.002) -> tuple[Array, Array, bool]:
    """Fit a plane to points (n, 3); return its centre (3,), axes (3, 3), and whether it is flat.

    The axes are right-handed rows, the last of them the normal. Flat: the RMS distance from the
    plane is below `tolerance` times the RMS extent in it.
    """
    X = np.asarray(points, dtype=float)
    centre = X.mean(axis=0)
    reduced = X - centre
    s2, vectors = np.linalg.eigh(reduced.T @ reduced)
    axes = vectors.T[::-1].copy()
    (a, b, c), (d, e, f) = axes[0], axes[1]
    axes[2] = (b * f - c * e, c * d - a * f, a * e - b * d)  # right-handed
    return centre, axes, bool(s2[0] <= tolerance**2 * max(s2[2], 1e-300))


@lru_cache(maxsize=16)
def field_sheets(testfield: TestField) -> NDArray[np.int64]:
    """Return the label (n,) of each target's board, -1 for targets on none."""
    labels = _sheets(testfield.points, _SIGMAS * float(np.median(testfield.sigmas)))
    labels.setflags(write=False)
    return labels


def _sheets(points: Array, least: float) -> NDArray[np.int64]:
    """Return the label (n,) of each point's board, -1 for none; least: smallest tolerance, mm."""
    labels = np.full(len(points), -1, dtype=np.int64)
    if len(points) < FEWEST_ON_A_SHEET:
        return labels
    near, spacing = _neighbours(points)
    tolerance = max(_FLATNESS * spacing, least)
    left = np.ones(len(points), dtype=bool)
    count = 0
    while left.sum() >= _PLATE:
        rest = np.flatnonzero(left)
        seeds = rest[:: max(len(rest) // _SEEDS, 1)]
        planes = [_plane(points, near[s], left, tolerance) for s in seeds]
        best = max(planes, key=len, default=np.zeros(0, dtype=np.int64))
        if len(best) < _PLATE:
            break
        left[best] = False
        for board in _apart(points, best, _APART * spacing):
            if len(board) >= _PLATE:
                labels[board] = count
                count += 1
    taken = labels.copy()
    _exchange(points, labels, _APART * spacing, max(_CREASE * spacing, least))
    for back in (taken, np.full_like(labels, -1)):
        size = np.bincount(labels + 1)
        around = np.mean(labels[near[:, 1 : _PLATE + 1]] == labels[:, None], axis=1)
        # targets that are in a plane by chance have others nearer
        chance = np.bincount(labels + 1, around) < _AROUND * size
        none = (chance | (size < FEWEST_ON_A_SHEET))[labels + 1]
        labels[none] = back[none]
    compact = np.unique(labels, return_inverse=True)[1]
    return compact - int(labels.min() < 0)


def _neighbours(points: Array) -> tuple[NDArray[np.int64], float]:
    """Return the rows (n, k + 1) of each target and its nearest, and the spacing of targets, mm.

    The spacing is the median distance to the third nearest, which for corners of markers is on the
    next marker.
    """
    # not SciPy's tree, whose import takes 25 MB of the daemon's memory
    k = min(_SEED, len(points) - 1)
    near = np.empty((len(points), k + 1), dtype=np.int64)
    third = np.empty(len(points))
    for row, point in enumerate(points):
        distance = np.linalg.norm(points - point, axis=1)
        near[row] = np.argsort(distance, kind="stable")[: k + 1]
        third[row] = distance[near[row, min(3, k)]]
    return near, float(np.median(third))


def _plane(
    points: Array, near: NDArray[np.int64], left: NDArray[np.bool_], tolerance: float
) -> NDArray[np.int64]:
    """Return the remaining targets in the plane of `near`: a target and some of its neighbours."""
    inside = near[left[near]]
    found = np.zeros(0, dtype=np.int64)
    # the largest neighbourhood that is flat, since two boards may meet at an edge
    for size in (4, 6, _SEED + 1):
        some = inside[:size]
        if len(some) < 4:
            break
        centre, axes, _ = plane_fit(points[some])
        if np.abs((points[some] - centre) @ axes[2]).max() > tolerance:
            break
        found = some
    if not len(found):
        return found
    for _ in range(3):
        centre, axes, _ = plane_fit(points[found])
        off = np.abs((points - centre) @ axes[2])
        found = np.flatnonzero(left & (off <= tolerance))
        if len(found) < 3:
            return np.zeros(0, dtype=np.int64)
    return found


def _exchange(points: Array, labels: NDArray[np.int64], reach: float, least: float) -> None:
    """Give a board's targets farther than `least` mm from its plane to one whose plane is nearer.

    So a board that was found first gives back the rows of others that begin near an edge of it. The
    nearer plane must be twice as near, and a target of its board within `reach` mm. The planes are
    those of least absolute distances; labels (n,) are changed in place.
    """
    rows = np.flatnonzero(labels >= 0)
    for _ in range(_EXCHANGES if len(rows) else 0):
        off = np.full((labels.max() + 1, len(rows)), np.inf)
        for label in np.unique(labels[rows]):
            mine = points[labels == label]
            weight = np.ones((len(mine), 1))
            for _ in range(_ITERATIONS):
                centre = (weight * mine).sum(axis=0) / weight.sum()
                root = np.sqrt(weight) * (mine - centre)
                normal = np.linalg.svd(root, full_matrices=False)[2][2]
                weight = 1.0 / np.maximum(np.abs((mine - centre) @ normal), 0.1 * least)[:, None]
            off[label] = np.abs((points[rows] - centre) @ normal)
        best, own = off.argmin(axis=0), off[labels[rows], np.arange(len(rows))]
        before = labels.copy()
        for k in np.flatnonzero((own > least) & (off.min(axis=0) < 0.5 * own)):
            others = points[before == best[k]]
            if np.linalg.norm(others - points[rows[k]], axis=1).min() <= reach:
                labels[rows[k]] = best[k]
        if np.array_equal(labels, before):
            break


def _apart(points: Array, rows: NDArray[np.int64], distance: float) -> list[NDArray[np.int64]]:
    """Return the groups of targets in a plane that are connected by steps of at most `distance`."""
    left, groups = np.ones(len(rows), dtype=bool), []
    while left.any():
        group, ends = np.zeros(len(rows), dtype=bool), [int(np.argmax(left))]
        group[ends] = True
        while ends:
            steps = np.linalg.norm(points[rows] - points[rows[ends.pop()]], axis=1)
            reached = np.flatnonzero((steps <= distance) & ~group)
            group[reached] = True
            ends += reached.tolist()
        groups.append(rows[group])
        left &= ~group
    return groups
