"""What every store offers once it can list its series and read their columns."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Self

from thermocald.errors import StoreError
from thermocald.store.recording.readings import interpolate_readings

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.store.database.blob import ObservationRows
    from thermocald.store.database.epoch_table import StoredEpoch
    from thermocald.store.database.row import Event, StoredSeries

__all__ = ["SeriesReader", "StampedReader"]

_LISTED = 20


class SeriesReader(ABC):
    """An open store that is read, of a file or of a server; use it in a `with` block.

    Each has its own way to list series and to read their columns and epochs; finding a series and
    temperatures at the times of its frames follow from these.
    """

    path: Path
    _remedy = ""  # how a series is selected, where that is not by a name alone

    @abstractmethod
    def all_series(self) -> list[StoredSeries]:
        """All series, in the order in which they were started."""

    @abstractmethod
    def series_columns(self, series: StoredSeries, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Columns (E,) over all epochs by name."""

    @abstractmethod
    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
        """(E, 16, 16) covariances of some epochs, NaN for those without a result."""

    @abstractmethod
    def observation_rows(self, series: StoredSeries, first: int, last: int) -> ObservationRows:
        """The observations of the epochs numbered `first` to `last`, without their quality."""

    @abstractmethod
    def _epochs(
        self, series: StoredSeries, first: int, last: int | None, details: bool
    ) -> Iterator[StoredEpoch]: ...

    @abstractmethod
    def close(self) -> None:
        """Close it; may be called twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def epochs(
        self,
        series: StoredSeries,
        first: int = 0,
        last: int | None = None,
        *,
        details: bool = True,
    ) -> Iterator[StoredEpoch]:
        """The epochs numbered `first` to `last`, one after the other, in constant memory.

        details: False leaves out observations and covariances, and is faster.
        """
        return self._epochs(series, first, last, details)

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


class StampedReader(SeriesReader):
    """One whose times are as they were stamped, with the steps of the clock noted as events."""

    @abstractmethod
    def clock_steps(self, series: StoredSeries) -> list[Event]:
        """The steps of the clock while this series ran."""
