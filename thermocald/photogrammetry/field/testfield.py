"""The test field: known targets with their covariance, and what of them one image shows.

A camera that replays measurements instead of pictures gives a Frame whose metadata hold, under
`observations`, {"target": [name …], "x": [px …], "y": […], "sx": […], "sy": […]} and, where it is
known, "sxy" px². Names, not rows: the receiver has a test field of its own.
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


@dataclass(frozen=True, eq=False)
class TestField:
    """Known points: names, coordinates and standard deviations, what they look like.

    names: n unique strings; points (n, 3) mm; sigmas (n, 3) mm; diameters (n,) mm, NaN where it
    has none; kinds, codes: n strings as CONVENTIONS §3 defines them, a code may be empty.
    """

    __test__ = False  # pytest collects classes by their name

    names: tuple[str, ...]
    points: Array
    sigmas: Array
    diameters: Array
    kinds: tuple[str, ...]
    codes: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = (self.points.shape, self.sigmas.shape, self.diameters.shape)
        if shapes != ((n, 3), (n, 3), (n,)) or len(self.kinds) != n or len(self.codes) != n:
            raise TestFieldError(f"a test field of {n} targets has columns of shapes {shapes}")
        if len(set(self.names)) != n:
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise TestFieldError(f"target {twice!r} is duplicated in the test field")
        for array in (self.points, self.sigmas, self.diameters):
            array.setflags(write=False)

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
        """Build from columns; a scalar stands for all targets."""
        n = len(names)
        return cls(
            tuple(names),
            np.array(points, dtype=float).reshape(n, 3),
            np.array(np.broadcast_to(np.asarray(sigmas, dtype=float), (n, 3))),
            np.array(np.broadcast_to(np.asarray(diameters, dtype=float), (n,))),
            (kinds,) * n if isinstance(kinds, str) else tuple(kinds),
            (codes,) * n if isinstance(codes, str) else tuple(codes),
        )

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def index(self) -> dict[str, int]:
        """Row of each target by its name."""
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def circles(self) -> NDArray[np.bool_]:
        """Which targets (n,) are circles."""
        return np.array([kind == "circle" for kind in self.kinds], dtype=bool)

    @cached_property
    def groups(self) -> NDArray[np.int64]:
        """Label (n,) of what each target belongs to: the corners of one marker err together.

        By the code without its corner number, or the name without what follows its last point.
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
        """The targets of some rows (indices)."""
        r = np.asarray(rows, dtype=int)
        return TestField(
            tuple(self.names[i] for i in r),
            self.points[r],
            self.sigmas[r],
            self.diameters[r],
            tuple(self.kinds[i] for i in r),
            tuple(self.codes[i] for i in r),
        )


@dataclass(frozen=True, slots=True)
class Distance:
    """A measured distance between two targets, mm, with its standard deviation."""

    a: str
    b: str
    length: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Image points of one epoch.

    targets: n row numbers in the test field, unique; points (n, 2) px; sigmas (n, 2) px;
    covariances (n,) px² between x and y, None where none is known; quality: per-target extras by
    name, (n,) each, such as `blur` px.
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

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> Observations:
        """Some of the observations, by mask or rows."""
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
        """Build from covariances (n, 2, 2) px², in the order of the test field."""
        found = cls(
            rows,
            points,
            np.sqrt(np.stack([covariances[:, 0, 0], covariances[:, 1, 1]], axis=-1)),
            covariances[:, 0, 1],
            dict(quality),
        )
        if (rows[1:] < rows[:-1]).any():
            return found.select(np.argsort(rows, kind="stable"))
        return found

    @classmethod
    def none(cls) -> Observations:
        """Return no observations, with covariances of none."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))

    def joined(self, other: Observations) -> Observations:
        """Join another measurement of the frame; both are in the order of the test field.

        No target may be in both, and both have covariances. A quality that one does not have is
        NaN there.
        """
        if len(other) == 0:
            return self
        if len(self) == 0:
            return other
        targets = np.concatenate([self.targets, other.targets])
        order = np.argsort(targets, kind="stable")
        names = [*other.quality, *(k for k in self.quality if k not in other.quality)]

        def column(part: Observations, name: str) -> Array:
            return part.quality.get(name, np.full(len(part), np.nan))

        assert self.covariances is not None
        assert other.covariances is not None
        return Observations(
            targets[order],
            np.concatenate([self.points, other.points])[order],
            np.concatenate([self.sigmas, other.sigmas])[order],
            np.concatenate([self.covariances, other.covariances])[order],
            {k: np.concatenate([column(self, k), column(other, k)])[order] for k in names},
        )


def observations_to_lists(seen: Observations, field: TestField) -> dict[str, Any]:
    """Observations → lists by name, JSON-able."""
    lists: dict[str, Any] = {
        "target": [field.names[row] for row in seen.targets.tolist()],
        "x": seen.points[:, 0].tolist(),
        "y": seen.points[:, 1].tolist(),
        "sx": seen.sigmas[:, 0].tolist(),
        "sy": seen.sigmas[:, 1].tolist(),
    }
    if seen.covariances is not None:
        lists["sxy"] = seen.covariances.tolist()
    return lists


def observations_from_lists(lists: Mapping[str, Any], field: TestField) -> Observations:
    """The inverse of `observations_to_lists`; TestFieldError for a foreign target."""
    rows = [field.index.get(name, -1) for name in lists["target"]]
    if -1 in rows:
        name = lists["target"][rows.index(-1)]
        raise TestFieldError(
            f"target {name!r} was measured but is not in the test field; is it the right field?"
        )
    n = len(rows)
    return Observations(
        np.array(rows, dtype=np.int64),
        np.array([lists["x"], lists["y"]], dtype=float).T.reshape(n, 2),
        np.array([lists["sx"], lists["sy"]], dtype=float).T.reshape(n, 2),
        np.array(lists["sxy"], dtype=float) if "sxy" in lists else None,
    )
