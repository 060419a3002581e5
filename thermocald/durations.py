"""A duration as text, short, for a line or a column."""

from __future__ import annotations

import math


def short_duration(seconds: float) -> str:
    """A duration in the largest unit of which there are two: `90 s`, `2 min`, `3 h`, `12 d`.

    seconds: may be negative; `–` where it is not finite.
    """
    if not math.isfinite(seconds):
        return "–"
    for unit, size in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if abs(seconds) >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
