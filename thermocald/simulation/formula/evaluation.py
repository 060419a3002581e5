"""A formula on a temperature history: its values at the frames, and what errors of readings do.

Operators with memory work on the polygon of the reference's readings, which other channels are
interpolated to; pointwise ones at the times that are asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.simulation.formula.expression import TIME
from thermocald.simulation.operators import interpolation_matrix

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.formula.expression import Node
    from thermocald.simulation.history import History

__all__ = ["Evaluator"]


class Evaluator:
    """One history; what has been computed is kept, as formulas share their parts."""

    def __init__(self, history: History) -> None:
        self.history = history
        self.knots = history.polygon().times
        self._kept: dict[tuple[Node, bool], Array] = {}

    def values(self, node: Node, at_knots: bool = False) -> Array:
        """The values (E,) of a bound formula at the frames, or (K,) at the knots."""
        key = (node, at_knots)
        if key not in self._kept:
            self._kept[key] = self._computed(node, at_knots)
        return self._kept[key]

    def _computed(self, node: Node, at_knots: bool) -> Array:
        at = self.knots if at_knots else self.history.times
        if node.is_leaf:
            return self._leaf(node, at)
        kind = node.kind
        if kind.trajectory is not None:
            inner = self.values(node.inputs[0], at_knots=True)
            return kind.trajectory(self.knots, inner, *node.constants, at)
        assert kind.value is not None
        return kind.value(*(self.values(n, at_knots) for n in node.inputs), *node.constants)

    def _leaf(self, node: Node, at: Array) -> Array:
        if node.operator == TIME:
            return np.maximum(at, 0.0)
        if node.operator:
            if node.name not in self.history.columns:
                raise DataError(
                    f"there is no recorded column {node.name!r}, which the formula reads; there "
                    f"are: {', '.join(self.history.columns) or 'none'}"
                )
            return self.history.column(node.name, at)
        return self.history.polygon(node.name).at(at)

    def sensitivity(self, node: Node, channel: str, at_knots: bool = False) -> csr_array:
        """∂ values / ∂ readings of a channel, (E, R) or (K, R), sparse."""
        from scipy.sparse import csr_array, diags_array

        at = self.knots if at_knots else self.history.times
        if node.is_leaf:
            if node.operator or node.name != channel:
                return csr_array((len(at), len(self.history.reading_times)))
            p = self.history.polygon(channel)
            return interpolation_matrix(p.times, at) @ p.matrix
        kind = node.kind
        if kind.matrix is not None:
            inner = self.values(node.inputs[0], at_knots=True)
            carried = self.sensitivity(node.inputs[0], channel, at_knots=True)
            if not carried.nnz:
                return csr_array((len(at), carried.shape[1]))
            return csr_array(kind.matrix(self.knots, inner, *node.constants, at) @ carried)
        assert kind.slopes is not None
        slopes = kind.slopes(*(self.values(n, at_knots) for n in node.inputs), *node.constants)
        total = csr_array((len(at), len(self.history.reading_times)))
        for slope, inner_node in zip(slopes, node.inputs, strict=True):
            total = total + diags_array(slope) @ self.sensitivity(inner_node, channel, at_knots)
        return csr_array(total)

    def rate_jumps(self, node: Node, jump: Array) -> Array:
        """By how much (E,) the values change where rates at the frames are off by `jump` K/s."""
        if not any(n.operator == "rate" and n.inputs[0].is_leaf for n in node.walk()):
            return np.zeros(len(self.history.times))
        return np.abs(self._shifted(node, jump) - self.values(node))

    def _shifted(self, node: Node, jump: Array) -> Array:
        if node.operator == "rate" and node.inputs[0].is_leaf:
            return self.values(node) + jump
        if node.is_leaf or node.kind.remembers:
            return self.values(node)
        assert node.kind.value is not None
        return node.kind.value(*(self._shifted(n, jump) for n in node.inputs), *node.constants)
