"""Observations as plain lists by target name: for JSON, and for frames that were measured before.

A camera that replays measurements instead of pictures gives a Frame whose metadata hold, under
`observations`, {"target": [name …], "x": [px …], "y": […], "sx": […], "sy": […]} and, where it is
known, "sxy" px². Names, not rows: the receiver has a test field of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import TestFieldError
from thermocald.photogrammetry.field.testfield import Observations

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.photogrammetry.field.testfield import TestField

__all__ = ["observations_from_lists", "observations_to_lists"]


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
