"""How far c, x0, y0 of each epoch are from the start of their series, in px, for the outputs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from thermocald.photogrammetry.parameters import PARAMETER_NAMES, PRINCIPAL

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["START_EPOCHS", "SeriesDrift"]

START_EPOCHS = 10
"""The start of a series is the mean of so many of its first epochs with a result."""
_NAMES = PARAMETER_NAMES[PRINCIPAL]


class SeriesDrift:
    """Columns `drift_c_px`, `sd_drift_c_px` …, `pixel_pitch` for the rows of one series.

    pixel_pitch: mm; earlier: the first epochs of the series that are stored already, as rows. The
    standard deviation takes the epochs as independent: where they share a level that cancels in
    the difference, it is too large rather than too small.
    """

    def __init__(self, pixel_pitch: float, earlier: Iterable[dict[str, Any]] = ()) -> None:
        self._pitch = pixel_pitch
        self._start: list[dict[str, float]] = []
        for row in earlier:
            self._learn(row)

    def columns(self, row: dict[str, Any]) -> dict[str, float]:
        """The columns for one epoch; NaN without a result, and until the start is known."""
        self._learn(row)
        known = len(self._start) == START_EPOCHS and row.get("status") == "ok"
        result = {"pixel_pitch": self._pitch}
        for name in _NAMES:
            drift = sd = math.nan
            if known:
                drift = (row[name] - sum(s[name] for s in self._start) / START_EPOCHS) / self._pitch
                start = sum(s[f"sd_{name}"] ** 2 for s in self._start) / START_EPOCHS**2
                sd = math.sqrt(row[f"sd_{name}"] ** 2 + start) / self._pitch
            result |= {f"drift_{name}_px": drift, f"sd_drift_{name}_px": sd}
        return result

    def _learn(self, row: dict[str, Any]) -> None:
        if len(self._start) < START_EPOCHS and row.get("status") == "ok":
            self._start.append({k: float(row[k]) for n in _NAMES for k in (n, f"sd_{n}")})
