"""Observations in memory that are read in blocks of a size that the test wants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class InBlocks:
    """A grid as blocks of at most `size` epochs."""

    grid: Any
    size: int

    def __len__(self) -> int:
        return len(self.grid)

    def blocks(self, windows: Any = None) -> Any:
        """Yield the blocks."""
        return self.grid.blocks(windows, self.size)
