"""A look at one frame before a series begins: light, focus, geometry, in sentences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from thermocald.acquisition.pairing import PairedReadings
from thermocald.acquisition.pipeline import calibrate_frame, make_epoch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.hal import Frame


_BLURRED_PX = 3.0
_SATURATED = 0.02
_LOW_CONTRAST = 30.0
_NAMED = 5

_RULES: tuple[tuple[str, Callable[[float], bool], str], ...] = (
    ("saturation", lambda v: v > _SATURATED, "saturated: less light, or a shorter exposure"),
    ("blur", lambda v: v > _BLURRED_PX, "blurred: focus, or hold the camera still"),
    ("contrast", lambda v: abs(v) < _LOW_CONTRAST, "of low contrast: more light"),
)


@dataclass(frozen=True, slots=True)
class FrameCheck:
    """What was found, sentence by sentence; failed: why no series can begin, empty if one can."""

    found: tuple[str, ...]
    failed: str = ""


def check_frame(name: str, calibrator: Calibrator, frame: Frame) -> FrameCheck:
    """Measure and adjust a frame, and say what a person can mend."""
    nothing = PairedReadings(float("nan"), {}, float("nan"))
    calibrated = calibrate_frame(calibrator, make_epoch(1, frame, nothing), frame)
    result, seen = calibrated.adjustment, calibrated.epoch.observations
    field = calibrator.testfield
    found: list[str] = []
    if seen is not None and len(seen):
        blur = calibrated.extra.get("blur_px")
        blurred = "" if blur is None else f", blur {blur:.2f} px"
        found.append(f"{name}: {len(seen)} of {len(field)} targets{blurred}")
        found += _remarks(field.names, seen.targets, seen.quality)
    if not result.ok:
        return FrameCheck(tuple(found), f"{result.status}: {result.reason}")
    c, sd = result.values[0], result.sd[0]
    found.append(f"{name}: sigma0 {result.sigma0:.2f}, c {c:.5f} ± {sd:.5f} mm")
    return FrameCheck(tuple(found))


def _remarks(names: tuple[str, ...], targets: Any, quality: Mapping[str, Any]) -> Iterator[str]:
    for key, bad, words in _RULES:
        rows = [int(t) for t, v in zip(targets, quality.get(key, ()), strict=False) if bad(v)]
        if rows:
            shown = ", ".join(names[row] for row in rows[:_NAMED])
            more = f" and {len(rows) - _NAMED} more" if len(rows) > _NAMED else ""
            yield f"  target {shown}{more}: {words}"
