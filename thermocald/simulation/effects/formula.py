"""A formula as an effect: what was proposed where no effect of the catalogue has a name.

Its name is its text, so it stands in model files and commands as any other effect does:

    effects:
    - effect: integral(above(temperature, k))
      parameters: {k: {value: 30.2, unit: degC}, c: {value: 1.1e-06, unit: mm/(K s)}}
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.simulation.effects.base import Effect
from thermocald.simulation.effects.parameter import Parameter, coefficient_units, spoken
from thermocald.simulation.formula.evaluation import Evaluator
from thermocald.simulation.formula.expression import Node, parse, unit_text

if TYPE_CHECKING:
    from collections.abc import Mapping

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.simulation.formula.operators import Constant
    from thermocald.simulation.history import History

__all__ = ["formula_effect", "is_formula"]


@dataclass(frozen=True, slots=True)
class _FormulaConstant(Parameter):
    """A constant of a formula; its size is whatever the formula's input has."""

    positive: bool = False

    def difference_step(self, value: float) -> float:
        if self.positive:
            return 1e-3 * max(abs(value), 1e-6)
        return 0.02 if self.unit == "degC" else 1e-3 * max(abs(value), 1e-6)


class _OfFormula(Effect):
    """Adds a × formula. The formula is data: a tree of known operators over recorded quantities."""

    kind = "signal"
    usual = ("c", "x0", "y0")
    node: ClassVar[Node]

    def _bound(self, history: History, values: Mapping[str, Any]) -> tuple[Evaluator, Node]:
        return Evaluator(history), self.node.bound(values)

    def channel(self, history: History, **_: Any) -> str:
        channels = self.node.channels()
        return history.reference if history.reference in channels or not channels else channels[0]

    def signal(self, history: History, **nonlinear: Any) -> Array:
        evaluator, node = self._bound(history, nonlinear)
        return evaluator.values(node)[:, None]

    def sensitivity(self, history: History, **nonlinear: Any) -> csr_array:
        evaluator, node = self._bound(history, nonlinear)
        return evaluator.sensitivity(node, self.channel(history))

    def further_sensitivities(self, history: History, **nonlinear: Any) -> dict[str, csr_array]:
        evaluator, node = self._bound(history, nonlinear)
        first = self.channel(history)
        others = [name for name in self.node.channels() if name != first]
        found = {name: evaluator.sensitivity(node, name) for name in others}
        return {name: matrix for name, matrix in found.items() if matrix.nnz}

    def unresolved(
        self, history: History, rate_jump: Array | None = None, **nonlinear: Any
    ) -> Array:
        if rate_jump is None:
            return np.zeros(len(history.times))
        evaluator, node = self._bound(history, nonlinear)
        return evaluator.rate_jumps(node, rate_jump)

    def sentence(self, estimates: Mapping[str, Mapping[str, Any]]) -> str:
        said = {
            name: _said(e, self.nonlinear[name]).replace("degC", "°C")
            for name, e in estimates.items()
            if name in self.nonlinear
        }
        moved = [n[2:] for n in estimates if n.startswith("a_")]
        verb = "follow" if len(moved) > 1 else "follows"
        return f"{', '.join(moved) or 'the camera'} {verb} {self.node.words(said)}"


def _said(estimate: Mapping[str, Any], parameter: Parameter) -> str:
    """An estimate in words; one of a positive constant that is not determined as about so much."""
    value, sd = estimate["value"], estimate["sd"]
    if parameter.log and sd is not None and not sd <= abs(value):
        return f"about {value:.3g} {parameter.unit}"
    return spoken(estimate)


def formula_effect(text: str) -> Effect:
    """The effect of a formula. ConfigurationError where its text cannot be read."""
    tree = parse(text)
    per = unit_text(tree.unit())

    class OfFormula(_OfFormula):
        name = text
        noun = f"an influence that follows {tree.words({})}"
        node = tree
        nonlinear: ClassVar[Mapping[str, Parameter]] = {
            constant_name: _parameter(owner.unit_of(constant), constant)
            for constant_name, constant, owner in tree.free()
        }
        linear: ClassVar[Mapping[str, str]] = coefficient_units(
            per if per.isalnum() else f"({per})"
        )

    return OfFormula()


def is_formula(name: str) -> bool:
    """Whether an effect's name is a formula's text: it calls an operator."""
    return "(" in name


def _parameter(unit: str, constant: Constant) -> Parameter:
    low, high = (1e-9, 1e9) if constant.positive else (-1e9, 1e9)
    start = {"degC": 30.0, "s": 60.0}.get(unit, 1.0)
    return _FormulaConstant(
        unit, low, high, start, log=constant.positive, positive=constant.positive
    )
