"""The test field: its targets with their standard deviations, and image observations.

A camera that replays observations instead of images gives a Frame whose metadata has, under
`observations`, {"target": [name …], "x": [px …], "y": […], "sx": […], "sy": […]} and, if known,
"sxy" px². Targets are given by name, not by row, because the receiver has a test field of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
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
