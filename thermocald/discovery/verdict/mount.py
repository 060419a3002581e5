"""What the mount did while the camera was watched: its movement, and when it was knocked."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from thermocald.discovery.search.examination import Examination
    from thermocald.reduction.hypothesis import Term

__all__ = ["mount_lines", "mount_of"]


def mount_of(x: Examination) -> dict[str, Any] | None:
    """Movement and knocks for the document; None where the mount stands still.

    movement_px: RMS over image points and time; knocks: recording, time s from its start, size_px.
    """
    if x.mount is None:
        return None
    knocks = [k for number, term in enumerate(x.base.terms) if term in x.knocks
              for k in _steps(x, number, term)]  # fmt: skip
    return {
        "movement_px": [x.mount.size_px(e) for e in x.fitter.series],
        "knocks": knocks,
        "note": "movement of the mount is estimated with the effects and is none of the camera's",
    }


def _steps(x: Examination, number: int, term: Term) -> list[dict[str, Any]]:
    """The steps of one event, one for each series in which it came."""
    out = []
    fit = x.base.fit
    for block in fit.blocks:
        if block.term != number or block.series is None:
            continue
        e = x.fitter.series[block.series]
        values = term.values(block.series) or {}
        time = float(next(iter(values.values())))
        first = int(np.searchsorted(e.times, time - 1e-6))
        before = float(e.times[max(first - 1, 0)])
        seen = e.weights[..., 0].any(axis=0)
        moved = np.einsum("tij,j->ti", e.columns[seen], fit.direction(block)[0])
        out.append(
            {
                "recording": e.source.name,
                "time_s": 0.5 * (before + time),
                "sd_time_s": (time - before) / float(np.sqrt(12.0)),
                "epoch": int(e.numbers[first]),
                "size_px": float(np.sqrt(np.mean(moved**2))),
            }
        )
    return out


def mount_lines(x: Examination) -> list[str]:
    """The same for people."""
    found = mount_of(x)
    if found is None:
        return []
    sizes = " and ".join(f"{v:.3f}" for v in found["movement_px"])
    lines = [f"the camera moves on its mount by {sizes} px RMS; this is not counted as an effect"]
    lines += [
        f"    a knock of {k['size_px']:.3f} px at {k['time_s']:.0f} s (epoch {k['epoch']}) in "
        f"{k['recording']}"
        for k in found["knocks"]
    ]
    return lines
