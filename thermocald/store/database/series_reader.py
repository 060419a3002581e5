"""What every store offers once it can list its series and read their columns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

from thermocald.errors import StoreError
from thermocald.store.recording.readings import interpolate_readings

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from thermocald.store.database.row import StoredSeries

    Array = NDArray[np.float64]

__all__ = ["SeriesReader"]

_LISTED = 20


class SeriesReader(ABC):
    """Finding a series, and temperatures at the times of its frames: of a file or of a server."""

    path: Path
    _remedy = ""  # how a series is selected, where that is not by a name alone

    @abstractmethod
    def all_series(self) -> list[StoredSeries]:
        """All series, in the order in which they were started."""

    @abstractmethod
    def series_columns(self, series: StoredSeries, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Columns (E,) over all epochs by name."""

    def find_series(self, camera: str | None = None, name: str | None = None) -> StoredSeries:
        """The one series of a camera and a name, either of which may be left open.

        Raises StoreError, listing what there is, if none or several fit.
        """
        every = self.all_series()
        found = [s for s in every if camera in (None, s.camera) and name in (None, s.name)]
        if len(found) != 1:
            there = ", ".join(self._label(s) for s in every[:_LISTED]) or "none"
            more = f" and {len(every) - _LISTED} more" if len(every) > _LISTED else ""
            raise StoreError(
                f"{self.path}: {'several series fit' if found else 'there is no such series'}; "
                f"camera/series in this store: {there}{more}{self._remedy}"
            )
        return found[0]

    def temperatures_at_frame(self, series: StoredSeries) -> dict[str, Array]:
        """Every channel at the times of the frames, {name: (E,) °C}."""
        names = ["frame_time", "temperature_time", *series.head.channels]
        columns = self.series_columns(series, names)
        return {
            name: interpolate_readings(
                columns["frame_time"], columns["temperature_time"], columns[name]
            )
            for name in series.head.channels
        }

    def _label(self, series: StoredSeries) -> str:
        return f"{series.camera}/{series.name}"
