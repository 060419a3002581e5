"""Formulas as effects, such as `integral(above(temperature, k))`, beyond the catalogue's names.

A leaf is a temperature channel (`temperature`), `time` (s since the first frame) or another
recorded column (`column("humidity")`). Constants are numbers or names; the names are the effect's
parameters. The text is parsed by Python's grammar and never executed: only calls of known
operators, names, numbers and quoted names are accepted.

Operators with memory work on the polygon of the reference's readings, to which other channels are
interpolated; pointwise operators work at the requested times. A formula is named by its text, and
so is written in model files and commands like any other effect:

    effects:
    - effect: integral(above(temperature, k))
      parameters: {k: {value: 30.2, unit: degC}, c: {value: 1.1e-06, unit: mm/(K s)}}
"""

from __future__ import annotations

import ast
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import ConfigurationError, DataError
from thermocald.numbers import parameter_label, with_sd
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.physics.effect import (
    PARAMETER_UNITS,
    Effect,
    Parameter,
    Steady,
    coefficient_units,
    say_estimate,
)
from thermocald.physics.operators import (
    OPERATORS,
    Constant,
    Operator,
    averaged_lag_matrix,
    interpolation_matrix,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from scipy.sparse import csr_array

    from thermocald.arrays import Array
    from thermocald.physics.effect import Estimates, Role, Values
    from thermocald.physics.history import History

TIME = "time"
_COLUMN = "column"
_LONGEST = 300  # characters of a formula
_DEEPEST = 8
_OFFSET_C = "degC"
_OWN_UNITS = {"time_constant": "s", "phase": "rad", "exponent": "1"}  # else that of the input
# the constants whose order of magnitude the recording shows, by role and unit
_SCANNED: dict[tuple[str, str], Role] = {
    ("threshold", _OFFSET_C): "threshold", ("time_constant", "s"): "time_constant"
}  # fmt: skip
_TOGETHER = 0.99  # correlation from which constants are determined only jointly
_ON_THE_CURVE = 41  # temperatures


@dataclass(frozen=True, slots=True)
class Node:
    """An operator with its inputs and constants, or a leaf.

    operator: a key of OPERATORS, or of a leaf "" (a temperature channel), "time", "column"; name:
    of the channel or column; constants: names, or numbers once bound.
    """

    operator: str
    inputs: tuple[Node, ...] = ()
    constants: tuple[str | float, ...] = ()
    name: str = ""

    @property
    def kind(self) -> Operator:
        """The operator; KeyError for a leaf."""
        return OPERATORS[self.operator]

    @property
    def is_leaf(self) -> bool:
        """Whether the node is a recorded quantity."""
        return not self.inputs

    @property
    def depth(self) -> int:
        """The number of nested operators."""
        return 0 if self.is_leaf else 1 + max(n.depth for n in self.inputs)

    @property
    def size(self) -> int:
        """The number of operators."""
        return sum(not n.is_leaf for n in self.walk())

    def walk(self) -> Iterator[Node]:
        """Yield the node and all nodes below it."""
        yield self
        for node in self.inputs:
            yield from node.walk()

    def channels(self) -> tuple[str, ...]:
        """Return the temperature channels in the formula, in order."""
        return tuple(dict.fromkeys(n.name for n in self.walk() if n.is_leaf and not n.operator))

    def free(self) -> Iterator[tuple[str, Constant, Node]]:
        """Yield the constants that are names: (name, the operator's constant, its node)."""
        for node in self.walk():
            if node.is_leaf:
                continue
            for value, constant in zip(node.constants, node.kind.constants, strict=True):
                if isinstance(value, str):
                    yield value, constant, node

    def bound(self, values: Values) -> Node:
        """Replace names by numbers, and channels by others; KeyError if a number is missing."""
        if self.is_leaf:
            name = values.get(self.name) if not self.operator else None
            return replace(self, name=name) if isinstance(name, str) else self
        return replace(
            self,
            inputs=tuple(n.bound(values) for n in self.inputs),
            constants=tuple(float(values[c]) if isinstance(c, str) else c for c in self.constants),
        )

    def simpler(self) -> Iterator[Node]:
        """Yield every formula with one operator fewer: a node replaced by one of its inputs."""
        yield from self.inputs
        for i, node in enumerate(self.inputs):
            for other in node.simpler():
                yield replace(self, inputs=(*self.inputs[:i], other, *self.inputs[i + 1 :]))

    def named(self) -> tuple[Node, dict[str, float]]:
        """Replace all numbers by names; return the formula, and the numbers by name."""
        values: dict[str, float] = {}

        def rename(node: Node) -> Node:
            if node.is_leaf:
                return node
            inputs = tuple(rename(n) for n in node.inputs)
            names: list[str | float] = []
            for value, constant in zip(node.constants, node.kind.constants, strict=True):
                name, k = constant.name, 2
                while name in values:
                    name, k = f"{constant.name}_{k}", k + 1
                values[name] = float(value)
                names.append(name)
            return replace(node, inputs=inputs, constants=tuple(names))

        return rename(self), values

    def text(self) -> str:
        """Return the text that `parse` reads and files hold."""
        if self.operator == TIME:
            return TIME
        if self.operator == _COLUMN:
            return f'column("{self.name}")'
        if self.is_leaf:
            return self.name if self.name.isidentifier() else f'"{self.name}"'
        parts = [n.text() for n in self.inputs]
        parts += [c if isinstance(c, str) else repr(float(c)) for c in self.constants]
        return f"{self.operator}({', '.join(parts)})"

    def steady(self, temperatures: Array) -> Array | None:
        """Return a bound formula's settled values (n,) at constant temperatures (n,) °C of all.

        None if it does not settle.
        """
        if self.is_leaf:
            return None if self.operator else temperatures
        inner = [v for n in self.inputs if (v := n.steady(temperatures)) is not None]
        if len(inner) < len(self.inputs):
            return None
        if not self.kind.remembers:
            return self.kind.value(*inner, *self.constants)
        if self.operator == "rate":
            return 0.0 * temperatures
        return inner[0] if self.kind.keeps else None

    # -- units ---------------------------------------------------------------------------------

    @property
    def is_celsius(self) -> bool:
        """Whether the values are temperatures, not differences or powers of them."""
        if self.is_leaf:
            return not self.operator
        return self.kind.keeps and self.inputs[0].is_celsius

    def unit(self) -> dict[str, int]:
        """Return the unit of the values as {unit: exponent}, of K, s and the columns' units."""
        if self.operator == TIME:
            return {"s": 1}
        if self.operator == _COLUMN:
            return {self.name: 1}
        if self.is_leaf:
            return {"K": 1}
        total = Counter[str]()
        for node in self.inputs:
            for name, power in node.unit().items():
                total[name] += power * self.kind.powers
        total["s"] += self.kind.seconds
        return {name: power for name, power in total.items() if power}

    def unit_of(self, constant: Constant) -> str:
        """Return the unit of one of the operator's constants."""
        if constant.role in _OWN_UNITS:
            return _OWN_UNITS[constant.role]
        if constant.role == "threshold" and self.inputs[0].is_celsius:
            return _OFFSET_C
        return unit_text(self.inputs[0].unit())

    # -- words ---------------------------------------------------------------------------------

    def words(self, spoken: Mapping[str, str], reference: str = "temperature") -> str:
        """Return the formula as mathematics; spoken: {name of a constant: text of its value}."""
        if self.operator == TIME:
            return "t"
        if self.is_leaf:
            if self.name == reference and not self.operator:
                return "T"
            label = parameter_label(self.name)
            return label if label.isalnum() else f'"{label}"'  # not taken for several quantities
        inner = [n.words(spoken, reference) for n in self.inputs]
        own = [spoken.get(str(c), f"{c:.4g}" if not isinstance(c, str) else c)
               for c in self.constants]  # fmt: skip
        return self.kind.words.format(*inner, *own)


def unit_text(powers: Mapping[str, int]) -> str:
    """Format a unit as in files: K s, K2/s, 1."""
    up = [f"{n}{p if p > 1 else ''}" for n, p in powers.items() if p > 0]
    down = [f"{n}{-p if p < -1 else ''}" for n, p in powers.items() if p < 0]
    if not up and not down:
        return "1"
    return "/".join([" ".join(up) or "1", *down])


def parse(text: str) -> Node:
    """Parse a formula; ConfigurationError names what cannot be read."""
    if len(text) > _LONGEST:
        raise ConfigurationError(f"a formula has at most {_LONGEST} characters: {text[:40]} …")
    try:
        tree = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigurationError(f"formula {text!r} cannot be read") from error
    node = _parse_node(tree, text, 0)
    names = [name for name, _, _ in node.free()]
    if len(set(names)) < len(names):
        raise ConfigurationError(f"formula {text!r}: each constant needs a name of its own")
    if taken := sorted(set(names) & set(PARAMETER_UNITS)):
        raise ConfigurationError(
            f"formula {text!r}: {taken[0]} is a parameter of the camera; "
            "give the constant another name"
        )
    return node


def _parse_node(tree: ast.expr, text: str, depth: int) -> Node:
    if depth > _DEEPEST:
        raise ConfigurationError(f"formula {text!r}: more than {_DEEPEST} nested operators")
    if isinstance(tree, ast.Name):
        return Node(TIME) if tree.id == TIME else Node("", name=tree.id)
    if isinstance(tree, ast.Constant) and isinstance(tree.value, str):
        return Node("", name=tree.value)
    if not (isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name)) or tree.keywords:
        raise ConfigurationError(
            f"formula {text!r}: {ast.unparse(tree)!r} is not a recorded quantity; give a "
            f'channel, time, column("…"), or one of {", ".join(OPERATORS)}'
        )
    name, arguments = tree.func.id, tree.args
    if name == _COLUMN:
        one = arguments[0] if len(arguments) == 1 else None
        if not (isinstance(one, ast.Constant) and isinstance(one.value, str)):
            raise ConfigurationError(f'formula {text!r}: write column("name")')
        return Node(_COLUMN, name=one.value)
    if name not in OPERATORS:
        raise ConfigurationError(
            f"formula {text!r}: there is no operator {name!r}; there are {', '.join(OPERATORS)}"
        )
    kind = OPERATORS[name]
    wanted = kind.inputs + len(kind.constants)
    if len(arguments) != wanted:
        raise ConfigurationError(
            f"formula {text!r}: {name} takes {wanted} arguments, not {len(arguments)}"
        )
    inputs = tuple(_parse_node(a, text, depth + 1) for a in arguments[: kind.inputs])
    constants = tuple(_parse_constant(a, text) for a in arguments[kind.inputs :])
    for value, constant in zip(constants, kind.constants, strict=True):
        if constant.positive and not (isinstance(value, str) or value > 0):
            raise ConfigurationError(f"formula {text!r}: {constant.name} of {name} is not above 0")
    return Node(name, inputs, constants)


def _parse_constant(tree: ast.expr, text: str) -> str | float:
    if isinstance(tree, ast.Name):
        return tree.id
    with suppress(ValueError, TypeError):
        number = ast.literal_eval(tree)
        if type(number) in (int, float):
            return float(number)
    raise ConfigurationError(
        f"formula {text!r}: {ast.unparse(tree)!r} is neither a number nor a name"
    )


class Evaluator:
    """Formulas on one history; values are cached, as formulas have parts in common."""

    def __init__(self, history: History) -> None:
        self.history = history
        self.knots = history.polygon().times
        self._cache: dict[tuple[Node, bool], Array] = {}

    def values(self, node: Node, at_knots: bool = False) -> Array:
        """Return the values (E,) of a bound formula at the frames, or (K,) at the knots."""
        key = (node, at_knots)
        if key in self._cache:
            return self._cache[key]
        at = self.knots if at_knots else self.history.times
        if not node.is_leaf:
            found = node.kind.value(*self._arguments(node, at_knots))
        elif node.operator == TIME:
            found = np.maximum(at, 0.0)
        elif not node.operator:
            found = self.history.polygon(node.name).at(at)
        elif node.name in self.history.columns:
            found = np.interp(at, *self.history.columns[node.name])
        else:
            raise DataError(
                f"there is no recorded column {node.name!r}, which the formula reads; there "
                f"are: {', '.join(self.history.columns) or 'none'}"
            )
        self._cache[key] = found
        return found

    def _arguments(self, node: Node, at_knots: bool) -> tuple[Any, ...]:
        """Return the arguments of a node's operator: its inputs' values, or a polygon and times."""
        if not node.kind.remembers:
            return *(self.values(n, at_knots) for n in node.inputs), *node.constants
        inner = self.values(node.inputs[0], at_knots=True)
        at = self.knots if at_knots else self.history.times
        return self.knots, inner, *node.constants, at

    def averaged(
        self, averages: csr_array, node: Node, channel: str, at_knots: bool = False
    ) -> csr_array:
        """Return averages @ ∂ values / ∂ readings of a channel, (B, R), sparse.

        averages (B, E), or (B, K) of values at the knots.
        """
        from scipy.sparse import csr_array, diags_array

        nothing = csr_array((averages.shape[0], len(self.history.reading_times)))
        if channel not in node.channels():
            return nothing
        if node.is_leaf:
            p, at = self.history.polygon(channel), self.knots if at_knots else self.history.times
            if at is not p.times:
                averages = averages @ interpolation_matrix(p.times, at)
            return averages @ p.matrix
        given = self._arguments(node, at_knots)
        if node.kind.remembers:
            if node.operator == "lag":
                inner = averaged_lag_matrix(averages, *given)
            else:
                inner = averages @ node.kind.derivatives(*given)
            return self.averaged(inner, node.inputs[0], channel, at_knots=True)
        total = nothing
        for slope, below in zip(node.kind.derivatives(*given), node.inputs, strict=True):
            inner = averages @ diags_array(slope)
            total = total + self.averaged(inner, below, channel, at_knots)
        return total

    def shifted(self, node: Node, jump: Array) -> Array:
        """Return the values (E,) if all rates of readings are changed by `jump` (E,), per s."""
        if node.operator == "rate" and node.inputs[0].is_leaf:
            return self.values(node) + jump
        if node.is_leaf or node.kind.remembers:
            return self.values(node)
        return node.kind.value(*(self.shifted(n, jump) for n in node.inputs), *node.constants)


class OfFormula(Effect):
    """A drive or a signal that is a formula.

    formula: its text, in which T is the temperature of the effect's `channel`, T0 the model's
    reference temperature, and other names are the effect's parameters.
    """

    formula: str

    @cached_property
    def node(self) -> Node:
        """The parsed formula."""
        return parse(self.formula)

    def bound(self, history: History, **nonlinear: Any) -> Node:
        """Return the formula with all values."""
        usual = {name: p.default for name, p in self.nonlinear.items()}
        T = self.channel(history, **nonlinear)
        return self.node.bound({**usual, "T": T, "T0": history.T0, **nonlinear})

    def drive(self, history: History, **nonlinear: Any) -> Array:
        return Evaluator(history).values(self.bound(history, **nonlinear))

    def signal(self, history: History, **nonlinear: Any) -> Array:
        return self.drive(history, **nonlinear)[:, None]

    def sensitivity(self, history: History, **nonlinear: Any) -> csr_array:
        return self.sensitivities(history, **nonlinear)[self.channel(history, **nonlinear)]

    def sensitivities(
        self, history: History, averages: csr_array | None = None, **nonlinear: Any
    ) -> dict[str, csr_array]:
        from scipy.sparse import csr_array, eye_array

        evaluator, node = Evaluator(history), self.bound(history, **nonlinear)
        if averages is None:
            averages = csr_array(eye_array(len(history.times)))
        names = dict.fromkeys([self.channel(history, **nonlinear), *node.channels()])
        return {name: evaluator.averaged(averages, node, name) for name in names}

    def unresolved(self, history: History, rate_jump: Array, **nonlinear: Any) -> Array:
        evaluator, node = Evaluator(history), self.bound(history, **nonlinear)
        return np.abs(evaluator.shifted(node, rate_jump) - evaluator.values(node))


class Proportional(OfFormula):
    """An effect whose signal is T - T₀, without delay; T is that of its `channel`."""

    formula = "offset(T, T0)"
    usual: tuple[str, ...] = IOP_NAMES[:3]
    of_now = True
    steady_signal = Steady((0.0, 1.0, 0.0))
    behaviour: Mapping[str, str] = {
        "hold": "does not move while the temperature is constant",
        "cycle": "runs along the same line up and down",
    }


class GivenFormula(OfFormula):
    """A signal a × formula that has no name but its text.

    Raises ConfigurationError if the text cannot be read.
    """

    usual = ("c", "x0", "y0")

    def __init__(self, text: str) -> None:
        self.name = self.formula = text
        self.noun = f"an influence that follows {self.node.words({})}"
        self.nonlinear = {}
        for name, constant, owner in self.node.free():
            unit, above_0 = owner.unit_of(constant), constant.positive
            start, low = {"degC": 30.0, "s": 60.0}.get(unit, 1.0), 1e-9 if above_0 else -1e9
            role = _SCANNED.get((constant.role, unit), "")
            self.nonlinear[name] = Parameter(
                unit, low, 1e9, start, log=above_0, role=role, sized=unit != _OFFSET_C
            )
        per = unit_text(self.node.unit())
        self.linear = coefficient_units(per if per.isalnum() else f"({per})")

    def bound(self, history: History, **nonlinear: Any) -> Node:  # noqa: ARG002
        return self.node.bound(nonlinear)  # a channel may be named T

    def steady(self, values: Values, T0: float, channels: Mapping[str, float] | None) -> Steady:
        settles = self.node.bound(values).steady(np.zeros(1)) is not None
        # the signal itself, which may be any function, is added by the thermal camera
        return Steady() if settles else super().steady(values, T0, channels)

    def channel(self, history: History, **_: Any) -> str:
        channels = self.node.channels()
        return history.reference if history.reference in channels or not channels else channels[0]

    def sentence(self, estimates: Estimates) -> str:
        constants = {
            name: _format_constant(e, self.nonlinear[name]).replace("degC", "°C")
            for name, e in estimates.items()
            if name in self.nonlinear
        }
        moved = [n[2:] for n in estimates if n.startswith("a_")]
        verb = "follow" if len(moved) > 1 else "follows"
        return f"{', '.join(moved) or 'the camera'} {verb} {self.node.words(constants)}"


def _format_constant(estimate: Values, parameter: Parameter) -> str:
    """Format an estimate, with "about" if it is not determined."""
    value, sd = estimate["value"], estimate["sd"]
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    if sd is None or (parameter.log and not sd <= abs(value)):
        return f"about {value:.{2 if sd is None else 3}g}{unit}"
    return say_estimate(estimate)


def known_together(
    text: str,
    values: Mapping[str, float],
    moved: Sequence[str],
    covariance: Array,
    temperatures: tuple[float, float, float],
    exchanged: Sequence[str] = (),
) -> dict[str, Any] | None:
    """Return the joint result for constants that the data determine only together, or None.

    values: the formula's constants, then the sizes and the rates of the parameters that it moves
    (`moved`); covariance: of all of these; temperatures °C: the lowest, the mean, the highest;
    exchanged: constants of which the data determine nothing separately. Further constants are tied
    if they correlate by 0.99 with another constant or with a size. None if no constant is tied.

    The result has slope and curvature, at the mean, of the parabola that fits best over the range;
    they include the rate, which is correlated with the formula's own slope. A formula that is not a
    function of one temperature has neither.
    """
    names, x, P = list(values), np.array(list(values.values())), len(moved)
    L = len(names) - 2 * P
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))[: L + P]
    r = covariance[: L + P, : L + P] / np.maximum(np.outer(sd, sd), 1e-300)
    most = np.abs(r - np.eye(L + P))[:L].max(axis=1, initial=0.0)
    found = [n for n, one in zip(names[:L], most, strict=True) if one > _TOGETHER]
    tied = list(dict.fromkeys([*exchanged, *found]))
    if not tied:
        return None
    effect, (low, mean, high) = GivenFormula(text), temperatures
    # a temperature that may be anywhere in the range, or beyond
    exchanged = exchanged or [
        n
        for n, one in zip(names, sd, strict=False)
        if n in found and effect.nonlinear[n].unit == _OFFSET_C and one > high - low
    ]
    T = np.linspace(low, high, _ON_THE_CURVE)
    parabola = np.linalg.pinv(np.vander(T - mean, 3, increasing=True))[1:] * [[1.0], [2.0]]

    def course(x: Array) -> Array | None:  # slope and curvature (2, P)
        f = effect.node.bound(dict(zip(names, x.tolist(), strict=True))).steady(T)
        if f is None or len(effect.node.channels()) > 1:
            return None
        return np.outer(parabola @ f, x[L : L + P]) + [[1.0], [0.0]] * x[L + P :]

    r_most = 1.0 if exchanged else min(float(most.max()), 1.0)
    out: dict[str, Any] = {
        "parameters": tied, "exchanged": bool(exchanged), "correlation": r_most
    }  # fmt: skip
    at = course(x)
    if at is None:
        return out
    own = [effect.nonlinear[n].difference_step(v) for n, v in zip(names[:L], x, strict=False)]
    steps = np.diag([*own, *[1.0] * 2 * P])  # linear in sizes and rates
    J = np.array([np.array(course(x + d)) - np.array(course(x - d)) for d in steps])
    J /= 2.0 * steps.sum(axis=1)[:, None, None]
    if not J[:L].any():  # constants of a lag, which do not matter at a steady temperature
        return out
    variance = np.einsum("iwp,ij,jwp->wp", J, covariance, J)
    sds = np.sqrt(np.maximum(variance, 0.0))
    for row, (what, per) in enumerate((("slope", "K"), ("curvature", "K2"))):
        out[what] = {
            p: {
                "value": float(at[row, j]),
                "sd": float(sds[row, j]),
                "unit": f"{PARAMETER_UNITS[p]}/{per}",
            }
            for j, p in enumerate(moved)
        }
    return {**out, "temperature": mean}


def say_together(known: Mapping[str, Any]) -> str:
    """Write the result of `known_together` as the end of a sentence."""
    names = ", ".join(known["parameters"])
    if known["exchanged"]:
        text = f"{names} and the size are known only together, as other values fit as well"
    else:
        r = known["correlation"]
        text = f"{names} and the size are best known together, as they correlate by {r:.4f}"
    if "slope" not in known:
        return text
    parts = []
    for name, slope in known["slope"].items():
        factor, unit = (1e3, "µm") if slope["unit"] == "mm/K" else (1.0, slope["unit"][:-2])
        both = [
            with_sd(factor * e["value"], factor * e["sd"], f"{unit}/{per}")
            for e, per in ((slope, "K"), (known["curvature"][name], "K²"))
        ]
        parts.append(f"{name} {' and '.join(both)}")
    return f"{text}: slope and curvature at {known['temperature']:.1f} °C are {', '.join(parts)}"


def is_formula(name: str) -> bool:
    """Return whether an effect's name is a formula, that is, calls an operator."""
    return "(" in name
