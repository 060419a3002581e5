"""The course of one parameter over a series, and whether it drifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from thermocald.numbers import percent, signed

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

LEVEL = 0.01
"""Significance level: a change whose p-value is smaller is a drift."""


_CARRIED = 0.5  # error of a change due to c, in its standard deviations, that is reported


def carried_by_c(share: float, changes: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Return the errors of changes due to the uncertainty of c, in their sds; {} if all are small.

    share: sd of c over c (an image shows a change relative to c); changes: {name: (value, sd)}.
    """
    sds = {name: abs(v) * share / sd for name, (v, sd) in changes.items() if v and sd > 0}
    return sds if max(sds.values(), default=0.0) > _CARRIED else {}


def say_carried(share: float, sds: float) -> str:
    """State the largest error of changes due to the uncertainty of c, in their sds."""
    return (
        f"the field determines c only to {percent(share, 2)}, and changes have the same relative "
        f"error: up to {sds:.1f} of their standard deviations; use a field with depth whose "
        "coordinates are known better"
    )


@dataclass(frozen=True, slots=True)
class Course:
    """One parameter over a series, in its own unit.

    mean; scatter: standard deviation over the epochs, and sd: stated by the adjustments, RMS, both
    without epochs in which the mount was touched; change: of a straight line from the first to the
    last epoch, with sd_change; p: p-value of no change,
    corrected for the number of parameters; drifts: p below 1 %, with and without any single group
    of targets; rests_on: the group without which there would be no drift; per_kelvin,
    sd_per_kelvin, p_temperature: slope on the reference temperature, its standard deviation and
    corrected p-value, NaN if the temperature is constant or unknown; last_minus_first: with sd;
    sd_by_perspective: sd of that difference if the mount could be anywhere in each epoch: a slow
    movement of the mount cannot be excluded with a smaller one.
    """

    JSON: ClassVar = {
        "sd": "stated_sd", "sd_by_perspective": "sd_last_minus_first_by_perspective", "drifts": "",
        "moves": "drift", "scatter_over_sd": "scatter_over_sd",
    }  # fmt: skip

    name: str
    mean: float
    scatter: float
    sd: float
    change: float
    sd_change: float
    p: float
    drifts: bool
    rests_on: str | None = None
    per_kelvin: float = float("nan")
    p_temperature: float = float("nan")
    last_minus_first: float = float("nan")
    sd_last_minus_first: float = float("nan")
    sd_per_kelvin: float = float("nan")
    sd_by_perspective: float = float("nan")

    @property
    def moves(self) -> bool:
        """True if the parameter changes with time or with the temperature."""
        return self.drifts or self.p_temperature < LEVEL

    @property
    def in_words(self) -> str:
        """The significant change as text, or `none`."""
        if self.p_temperature < LEVEL:
            return self.movement
        if self.moves:
            return f"in time (p {self.p:.1g})"
        return f"none (only target {self.rests_on} moves)" if self.rests_on else "none"

    @property
    def movement(self) -> str:
        """The change as text: per kelvin if it follows the temperature, or else over the series."""
        if self.p_temperature < LEVEL:
            return signed(1e3 * self.per_kelvin, 1e3 * self.sd_per_kelvin, "µm/K")
        moved = signed(1e3 * self.last_minus_first, 1e3 * self.sd_last_minus_first, "µm")
        return f"{moved} from the first epoch to the last"

    @property
    def scatter_over_sd(self) -> float:
        """The ratio of the scatter to the stated standard deviation."""
        return self.scatter / self.sd


def table_of(drifts: Sequence[Course]) -> list[str]:
    """Return a line per parameter below a line of titles; [] without parameters."""
    titles = ("", "mean mm", "scatter µm", "sd µm", "ratio", "line µm ± sd",
              "last − first µm ± sd", "drift")  # fmt: skip
    rows = [
        (
            c.name, f"{c.mean:.5f}".replace("-", "−"), f"{1e3 * c.scatter:.3f}",
            f"{1e3 * c.sd:.3f}", f"{c.scatter_over_sd:.2f}",
            signed(1e3 * c.change, 1e3 * c.sd_change),
            signed(1e3 * c.last_minus_first, 1e3 * c.sd_last_minus_first), c.in_words,
        )
        for c in drifts
    ]  # fmt: skip
    if not rows:
        return []
    rows = [titles, *rows]
    width = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        " ".join([f"{name:<{width[0]}}", *map(str.rjust, right, width[1:])])
        for name, *right in rows
    ]
