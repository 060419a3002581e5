"""Two effects that could not be separated, and whether what was recorded since separates them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from thermocald.discovery.search.search import Search
from thermocald.errors import UsageError
from thermocald.reduction.blocks import in_blocks
from thermocald.reduction.calibrated import calibrated_thermometers
from thermocald.reduction.fit import HypothesisFitter
from thermocald.reduction.noise import with_correlated_noise
from thermocald.simulation import effects as catalogue

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.discovery.search.search import Solution
    from thermocald.reduction.series import ReducedSeries

__all__ = ["Separation", "alternatives", "separation"]

# by how much the score (-2 log L and penalty) of the other has to be worse; as `discover` lists it
_BAND = 14.0
_DRIVES_BAND = 120.0


@dataclass(frozen=True)
class Separation:
    """How two alternatives compare on what was recorded.

    difference: by how much the worse one scores worse; needed: from which on it is excluded;
    there: whether the better one explains more than the base model does.
    """

    better: str
    worse: str
    difference: float
    needed: float
    there: bool

    @property
    def separated(self) -> bool:
        """Whether one of the two is excluded."""
        return self.there and self.difference > self.needed

    @property
    def sentence(self) -> str:
        """For people."""
        if not self.there:
            return f"neither {self.better} nor {self.worse} shows yet"
        if self.separated:
            return (
                f"{self.better}: {self.worse} is excluded, its score is {self.difference:.0f} "
                f"worse (needed {self.needed:.0f})"
            )
        return (
            f"{self.better} scores {self.difference:.0f} better than {self.worse}; "
            f"needed are {self.needed:.0f}"
        )


def alternatives(text: str) -> tuple[str, str]:
    """The two effects of `A,B`; UsageError where they are not two that a series of epochs shows."""
    names = [n.strip() for n in text.split(",")]
    if len(names) != 2 or names[0] == names[1]:
        raise UsageError(f"--until-separated {text}: write two effects, such as A,B")
    for name in names:
        if catalogue.get(name).seen_in != "trajectory":
            raise UsageError(
                f"--until-separated {text}: {name} is seen in the image, not in the time series of "
                "the camera's parameters; heating differently does not separate it"
            )
    return names[0], names[1]


def separation(series: Sequence[ReducedSeries], first: str, second: str) -> Separation:
    """Compare two effects, each with the constants that fit it best, on all series together."""
    ready = [in_blocks(with_correlated_noise(e)) for e in calibrated_thermometers(series)]
    search = Search(HypothesisFitter(ready))
    base = search.base()
    found = sorted((_best(search, base, name) for name in (first, second)), key=lambda s: s.score)
    drives = all(catalogue.get(name).is_drive for name in (first, second))
    better, worse = found
    return Separation(
        better.names[-1], worse.names[-1], worse.score - better.score,
        _DRIVES_BAND if drives else _BAND, better.score < base.score,
    )  # fmt: skip


def _best(search: Search, base: Solution, name: str) -> Solution:
    """The best solution with one effect, over the sets of parameters that it may act on."""
    promises = [search.scan(c, base) for c in search.candidates if c.effect == name]
    if not promises:
        raise UsageError(
            f"{name} cannot be looked for in this series: it needs a quantity that was not recorded"
        )
    best = max(promises, key=lambda p: p.net)
    return search.refine((*base.terms, best.term), (*base.penalties, best.penalty))
