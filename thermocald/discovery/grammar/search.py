"""The search for a formula: a library on a grid, the best made exact, then one operator further.

Scored as the catalogue's effects are (`discovery.search.search`): the gain in χ² less

    coefficients · ln n + constants · ln n + 2 ln(trials) + margin,

n the number of epochs, trials how many formulas were tried. Everything runs on condensed evidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery.grammar.library import Library

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.discovery.grammar.condensed import Condensed
    from thermocald.simulation.formula.expression import Node
    from thermocald.simulation.formula.operators import Constant

__all__ = ["FormulaSearch", "Found"]

_WIDTH = 16  # structures whose constants are made exact
_KEPT = 800  # formulas of a library that are tried again under other covariances
_FURTHER = 3  # of them that are taken one operator further
_STEPS = 2  # how many operators further
_ITERATIONS = 6
_SIMPLER = 0.25  # log of what is left: one operator more has to leave a quarter less


@dataclass(frozen=True, eq=False)
class Found:
    """A formula with its constants, the χ² it explains, and what the search for it costs."""

    node: Node
    gain: float
    penalty: float

    @property
    def net(self) -> float:
        return self.gain - self.penalty


class FormulaSearch:
    """One search over what some series recorded."""

    def __init__(
        self, evidence: Condensed, margin: float, before: FormulaSearch | None = None
    ) -> None:
        """before: a search over the same series with other covariances; its worst are left out."""
        self.margin = margin
        self.evidence = evidence
        if before is None:
            self.library = Library(evidence.histories)
            self.nodes = self.library.first()
            self.tried = len(self.nodes)
            self.nodes, self.stack = self._finite(self.nodes)
        else:
            self.library, self.tried = before.library, before.tried
            kept = np.sort(np.argsort(-before.gains)[:_KEPT])
            self.nodes, self.stack = [before.nodes[i] for i in kept], before.stack[:, kept]
        self.regressors = evidence.regressors(self.stack)
        self.gains: Array = np.sum((self.regressors @ evidence.data) ** 2, axis=1)

    def _finite(self, nodes: Sequence[Node]) -> tuple[list[Node], Array]:
        """The formulas that have values everywhere and change, and their trajectories (rows, G)."""
        with np.errstate(all="ignore"):
            stack = self.library.stack(nodes)
            good = np.isfinite(stack).all(axis=0) & (np.ptp(stack, axis=0) > 0)
        return [n for n, ok in zip(nodes, good, strict=True) if ok], stack[:, good]

    def best(self, further: bool = True) -> list[Found]:
        """Formulas, best first, each structure once; further: with operators added, too."""
        found = self._exact(self.nodes, self.gains, _WIDTH)
        for _ in range(_STEPS if further else 0):
            if self._left(found[0].gain) < 0.5 * len(self.evidence.data):
                break
            more: list[Node] = []
            for one in found[:_FURTHER]:
                more += self.library.further(one.node)
            before = found[0]
            found = sorted([*found, *self._tried(more)], key=self._rank, reverse=True)
            if self._rank(found[0]) <= self._rank(before):
                break
        return found

    def _tried(self, nodes: Sequence[Node]) -> list[Found]:
        """Formulas one operator further, the most promising exact."""
        self.tried += len(nodes)
        kept, stack = self._finite(nodes)
        return self._exact(kept, self.evidence.gains(stack), _WIDTH // 2)

    def _rank(self, found: Found) -> float:
        """What it explains, by what it leaves; a further operator has to leave a quarter less."""
        return self._ranked(found.node, found.gain)

    def _ranked(self, node: Node, gain: float) -> float:
        return -float(np.log(self._left(gain))) - _SIMPLER * _size(node)

    def _exact(self, nodes: Sequence[Node], gains: Array, width: int) -> list[Found]:
        """The best structures with constants that fit best."""
        order = np.argsort([-self._ranked(n, float(g)) for n, g in zip(nodes, gains, strict=True)])
        seen: dict[Node, Node] = {}
        for i in order:
            structure = nodes[i].named()[0]
            if structure not in seen:
                seen[structure] = nodes[i]
            if len(seen) == width:
                break
        out = [self._refined(node) for node in seen.values()]
        return sorted(out, key=self._rank, reverse=True)

    def _refined(self, node: Node) -> Found:
        """The constants that explain most: Gauss-Newton, the coefficients eliminated."""
        structure, values = node.named()
        constants = list(structure.free())
        x = np.array([values[name] for name, _, _ in constants])
        steps = np.array([self._step(owner.bound(values), c, v)
                          for (_, c, owner), v in zip(constants, x, strict=True)])  # fmt: skip
        library = Library(self.evidence.histories)
        low, high = np.array([self._limits(owner.bound(values), c) for _, c, owner in constants]
                             or np.zeros((0, 2))).T  # fmt: skip

        def at(x: Array) -> Node:
            names = (name for name, _, _ in constants)
            return structure.bound(dict(zip(names, x.tolist(), strict=True)))

        def moved(x: Array, step: Array) -> Array:
            positive = np.array([c.positive for _, c, _ in constants], dtype=bool)
            factor = np.exp(np.clip(step / np.where(x == 0, 1.0, x), -1.0, 1.0))
            return np.clip(np.where(positive, x * factor, x + step), low, high)

        trajectory = library.values(at(x))
        gain = float(self.evidence.gains(trajectory[:, None])[0])
        for _ in range(_ITERATIONS if len(x) else 0):
            sides = [library.values(at(moved(x, d))) for d in np.diag(steps)]
            shift = self._newton(trajectory, np.stack(sides, axis=1) - trajectory[:, None])
            improved = False
            for damping in (1.0, 0.4, 0.1):
                trial = moved(x, damping * shift * steps)
                candidate = library.values(at(trial))
                if not np.isfinite(candidate).all() or np.ptp(candidate) <= 0:
                    continue
                new = float(self.evidence.gains(candidate[:, None])[0])
                if new > gain:
                    improved = new > gain + 1e-4 * self._left(gain)
                    x, trajectory, gain = trial, candidate, new
                    break
            if not improved:
                steps = 0.25 * steps
        return Found(at(x), gain, self._penalty(len(x)))

    def _newton(self, trajectory: Array, slopes: Array) -> Array:
        """The step of the constants (n,), in the units of `slopes` (rows, n)."""
        Z = self.evidence.whitened(trajectory[:, None])[0].T
        slopes = np.nan_to_num(slopes)
        weights = np.linalg.lstsq(Z, self.evidence.data, rcond=1e-10)[0]
        D = np.einsum("k,gkr->rg", weights, self.evidence.whitened(slopes))
        X = np.hstack([Z, D])
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        out: Array = (np.linalg.lstsq(X / size, self.evidence.data, rcond=1e-6)[0] / size)[
            Z.shape[1] :
        ]
        return out

    def _step(self, owner: Node, constant: Constant, value: float) -> float:
        """A step of a constant that changes the formula somewhat."""
        if constant.positive or constant.role == "phase":
            return 0.05 * max(abs(value), 1.0 if constant.role == "phase" else 0.0)
        low, high = self.library.span(owner.inputs[0])
        return 0.03 * (high - low)

    def _limits(self, owner: Node, constant: Constant) -> tuple[float, float]:
        """Where a constant may be: a threshold near the range of what it is applied to."""
        low, high = self.library.span(owner.inputs[0])
        width = high - low
        if constant.role == "time_constant":
            return 0.25 * self.library.taus[0], 3.0 * self.library.duration
        if constant.role == "threshold":
            reach = 3.0 * width if owner.operator == "offset" else 0.1 * width
            return low - reach, high + reach
        if constant.role == "exponent":
            return 0.1, 6.0
        return (1e-3 * width, 10.0 * width) if constant.positive else (-np.inf, np.inf)

    def _left(self, gain: float) -> float:
        """χ² that is left beyond the noise, never quite none."""
        r = len(self.evidence.data)
        return max(self.evidence.power - gain - r, 0.0) + 0.1 * r

    def _penalty(self, constants: int) -> float:
        n = np.log(self.evidence.epochs)
        return float(
            (len(self.evidence.root) + constants) * n + 2 * np.log(max(self.tried, 1)) + self.margin
        )

    def surrogates(self, count: int, rng: np.random.Generator) -> tuple[float, Array]:
        """Share of the misfit that the library explains at best, of the data and of surrogates."""
        data = self.evidence.surrogates(count, rng)
        power = np.maximum(np.sum(data**2, axis=0), 1e-300)
        gains = self.evidence.gains_of(self.regressors, np.column_stack([data, self.evidence.data]))
        top = gains.max(axis=0)
        return float(top[-1] / self.evidence.power), top[:-1] / power


def _size(node: Node) -> int:
    return sum(not n.is_leaf for n in node.walk())
