"""The library: formulas that are tried first, on a grid of constants, and those one step further.

    recorded quantity → memory (lag, play, …) → shape (power, threshold, …) → memory (integral, …)

Grids follow what was recorded: thresholds lie within the range, time constants within the duration.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.simulation.formula.evaluation import Evaluator
from thermocald.simulation.formula.expression import TIME, Node
from thermocald.simulation.formula.operators import OPERATORS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.simulation.history import History

__all__ = ["Library"]

_MEMORIES = ("lag", "play", "peak", "maximum", "minimum")


class Library:
    """The formulas over what all of some histories hold."""

    def __init__(self, histories: Sequence[History]) -> None:
        self.evaluators = tuple(Evaluator(h) for h in histories)
        first = histories[0]
        self.reference = Node("", name=first.reference)
        others = [Node("", name=n) for n in first.readings if n != first.reference]
        others += [Node("column", name=n) for n in first.columns]
        self.leaves = [n for n in (self.reference, *others) if self._varies(n)]
        duration = max(float(h.times[-1]) for h in histories)
        step = float(np.median(np.diff(first.times)))
        self.duration = duration
        self.taus = np.geomspace(max(step, duration / 120), duration / 2, 7)

    def _varies(self, leaf: Node) -> bool:
        for e in self.evaluators:
            known = e.history.columns if leaf.operator else e.history.readings
            if leaf.name not in known or np.ptp(e.values(leaf)) <= 0:
                return False
        return True

    def values(self, node: Node) -> Array:
        """The trajectory (rows,) of a bound formula over all histories, one after the other."""
        return np.concatenate([e.values(node) for e in self.evaluators])

    def stack(self, nodes: Sequence[Node]) -> Array:
        """The trajectories (rows, G)."""
        return np.stack([self.values(n) for n in nodes], axis=1)

    def span(self, node: Node) -> tuple[float, float]:
        """The range of a formula's values."""
        v = self.values(node)
        return float(v.min()), float(v.max())

    # -- first tries -----------------------------------------------------------------------------

    def first(self) -> list[Node]:
        """Everything that is tried before anything is known."""
        out: list[Node] = []
        for leaf in self.leaves:
            for inner in self.remembered(leaf):
                out += [inner, *self.shapes(inner)]
            out += self.waves(leaf)
            for rated in self.rates(leaf):
                out += [rated, *self.shapes(rated, about_zero=True)]
            changed = _of("change", leaf)
            out += [_of(n, changed) for n in ("square", "cube", "magnitude", "signed_square")]
            out.append(_of("product", changed, Node(TIME)))
            for shape in (*self.offsets(leaf), *self.shapes(leaf)):
                out += self.remembered(shape, few=True)
                out.append(_of("integral", shape))
        out += self.products()
        return _distinct(out)

    def remembered(self, node: Node, few: bool = False) -> list[Node]:
        """A quantity through each operator with memory."""
        low, high = self.span(node)
        out = [] if few else [node]
        taus = self.taus[::2] if few else self.taus
        out += [_of("lag", node, tau) for tau in taus]
        out += [_of("maximum", node)]
        if few:
            return out
        out += [_of("lag", _of("lag", node, tau), tau) for tau in taus[:-1]]
        out += [_of("play", node, r) for r in (high - low) * np.geomspace(0.04, 0.35, 5)]
        out += [_of("minimum", node)]
        out += [_of("peak", node, tau) for tau in taus[1:]]
        return out

    def rates(self, node: Node) -> list[Node]:
        """The rate of a quantity, at once and smoothed."""
        smooth = [_of("rate", _of("lag", node, tau)) for tau in self.taus[1:5]]
        return [_of("rate", node), *smooth]

    def offsets(self, node: Node, few: bool = False) -> list[Node]:
        """A quantity counted from somewhere else."""
        low, high = self.span(node)
        width = high - low
        far = low + width * np.array([-3.0, -1.0, -0.2, 0.5, 1.2, 2.0, 4.0])
        places = far if few else np.linspace(low - 0.5 * width, high + 0.5 * width, 9)
        return [_of("offset", node, a) for a in places]

    def shapes(self, node: Node, about_zero: bool = False) -> list[Node]:
        """A quantity through each pointwise operator."""
        low, high = self.span(node)
        width = max(high - low, 1e-12)
        inside = np.linspace(low, high, 11)[1:-1]
        out = [_of("above", node, k) for k in inside]
        out += [
            _of("saturation", node, k, w * width) for k in inside[::2] for w in (0.01, 0.08, 0.25)
        ]
        if about_zero:
            names = ("square", "signed_square", "magnitude", "cube")
            return out + [_of(name, node) for name in names]
        middle = _of("offset", node, 0.5 * (low + high))
        out += [_of("square", middle), _of("cube", middle), _of("magnitude", middle)]
        out += [
            _of("power", _of("above", node, k), p)
            for k in (low - 0.02 * width, *inside[1:6:2])
            for p in (0.5, 2.0, 3.0)
        ]
        out += [_of("exponential", node, w * width) for w in (0.12, 0.4)]
        return out

    def waves(self, node: Node) -> list[Node]:
        """A quantity that comes back to the same again and again, as interference does."""
        low, high = self.span(node)
        periods = (high - low) * np.array([0.2, 0.3, 0.45, 0.7])
        return [_of("wave", node, P, phi) for P in periods for phi in np.arange(4) * np.pi / 4]

    def products(self) -> list[Node]:
        """Products of two quantities."""
        time, out = Node(TIME), [_of("square", Node(TIME)), _of("power", Node(TIME), 0.5)]
        for i, leaf in enumerate(self.leaves):
            for offset in self.offsets(leaf, few=True):
                out.append(_of("product", offset, time))
                others = [n for n in self.leaves if n != leaf]
                out += [_of("product", offset, n) for n in others]
                out += [_of("product", offset, _of("rate", n)) for n in self.leaves]
            out += [_of("product", _of("rate", leaf), _of("rate", n)) for n in self.leaves[i + 1 :]]
        return out

    # -- one step further --------------------------------------------------------------------------

    def further(self, node: Node) -> list[Node]:
        """A formula with one operator more: around it, at its quantities, or a factor."""
        out = [*self.remembered(node)[1:], _of("rate", node), _of("integral", node)]
        out += self.shapes(node)
        out += [_of("product", o, node) for leaf in self.leaves
                for o in self.offsets(leaf, few=True)]  # fmt: skip
        out.append(_of("product", node, Node(TIME)))
        for leaf in {n for n in node.walk() if n.is_leaf and n.operator != TIME}:
            out += [_replaced(node, leaf, inner) for inner in self.remembered(leaf)[1:]]
            out += [_replaced(node, leaf, other) for other in self.leaves if other != leaf]
        deepest = max(node.depth, 4)
        return [n for n in _distinct(out) if n.depth <= deepest]


def _of(operator: str, *parts: Node | float) -> Node:
    count = OPERATORS[operator].inputs
    inputs = tuple(p for p in parts[:count] if isinstance(p, Node))
    return Node(operator, inputs, tuple(float(p) for p in parts[count:] if not isinstance(p, Node)))


def _replaced(node: Node, leaf: Node, by: Node) -> Node:
    if node == leaf:
        return by
    return replace(node, inputs=tuple(_replaced(n, leaf, by) for n in node.inputs))


def _distinct(nodes: Sequence[Node]) -> list[Node]:
    """Each once; a thermometer itself is the catalogue's."""
    return [n for n in dict.fromkeys(nodes) if n.inputs or n.operator]
