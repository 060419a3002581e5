"""What a series adjusted in blocks gives: one row per epoch on disk, and a sample in full."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.series.spool import ColumnSpool
from thermocald.photogrammetry.series.words import Words

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index, Mask
    from thermocald.photogrammetry.series.block import Block
    from thermocald.photogrammetry.series.result import SeriesAdjustment


__all__ = ["LongAdjustment", "RowWriter"]

_MOST_SENTENCES = 60_000


@dataclass(frozen=True, eq=False)
class LongAdjustment:
    """A long series as adjusted; parameters in the order of `PARAMETER_NAMES`.

    rows: the epochs one by one; level_sd, trend_sd (16,), as in `SeriesAdjustment`; sample: some
    epochs, those of `sampled` (P,), as adjusted together: their covariances, residuals and offsets;
    passes: how often the observations were read.
    """

    rows: RowWriter
    level_sd: Array
    trend_sd: Array
    sample: SeriesAdjustment
    sampled: Index
    passes: int


class RowWriter:
    """The rows of a long series.

    values, sd (E, 16): NaN where an epoch has no result or a parameter was held, on disk (`release`
    takes what was used of them out of memory); sigma0, redundancy, stillness (E,); observed,
    rejected (E,): how many targets.
    """

    def __init__(self, epochs: int) -> None:
        self._spools = ColumnSpool(epochs, 16), ColumnSpool(epochs, 16)
        self.values, self.sd = (spool.array for spool in self._spools)
        self.sigma0, self.redundancy, self.stillness = np.full((3, epochs), np.nan)
        self.observed, self.rejected = np.zeros((2, epochs), dtype=np.int32)
        self._ok = np.zeros(epochs, dtype=bool)
        self._word, self._reason = np.zeros((2, epochs), dtype=np.uint16)
        self._words: dict[str, int] = {"": 0}

    def put(self, block: Block) -> None:
        """The epochs of a block."""
        here = slice(block.first, block.first + len(block.values))
        self.values[here] = block.values
        self.sd[here] = np.sqrt(np.where(block.variance > 0, block.variance, np.nan))
        self._ok[here] = [word == "ok" for word in block.status]
        self._word[here], self._reason[here] = (
            self._numbers(said) for said in (block.status, block.reasons)
        )
        self.sigma0[here], self.redundancy[here] = block.sigma0, block.redundancy
        self.stillness[here] = block.stillness
        self.observed[here], self.rejected[here] = block.observed, block.rejected

    def _numbers(self, sentences: list[str]) -> list[int]:
        for sentence in dict.fromkeys(sentences):
            if len(self._words) < _MOST_SENTENCES:
                self._words.setdefault(sentence, len(self._words))
        return [self._words.get(sentence, 0) for sentence in sentences]

    @property
    def status(self) -> Words:
        """One word per epoch."""
        return Words(self._word, tuple(self._words))

    @property
    def reasons(self) -> Words:
        """One sentence per epoch, "" where it has a result."""
        return Words(self._reason, tuple(self._words))

    @property
    def ok(self) -> Mask:
        """(E,): epochs with a result."""
        return self._ok

    def shift(self, columns: Index, change: Array) -> None:
        """Add a change (k,) to some parameters of all epochs."""
        for column, size in zip(columns, change, strict=True):
            self.values[:, column] += size
            self.release()

    def widen(self, columns: Index, variance: Array) -> None:
        """Add variances (k,) to some parameters of all epochs with a result."""
        for column, size in zip(columns, variance, strict=True):
            old = np.nan_to_num(self.sd[:, column])
            self.sd[:, column] = np.where(self._ok, np.sqrt(old**2 + size), np.nan)
            self.release()

    def release(self) -> None:
        """Take the values on disk out of memory."""
        for spool in self._spools:
            spool.release()
