"""The text of a formula and its tree: `integral(above(temperature, k))`.

A leaf is a temperature channel (`temperature`), `time`, s since the first frame, or another
recorded column (`column("humidity")`). Constants are numbers or names; the names are the effect's
parameters. The text is read as Python's grammar has it and never executed: anything but calls
of known operators, names, numbers and quoted names is refused.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from thermocald.errors import ConfigurationError
from thermocald.simulation.formula.operators import OPERATORS, Constant, Operator

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

__all__ = ["TIME", "Node", "parse"]

TIME = "time"
_COLUMN = "column"
_LONGEST = 300  # characters of a formula
_DEEPEST = 8
_OFFSET_C = "degC"


@dataclass(frozen=True, slots=True)
class Node:
    """An operator with its inputs and constants, or a leaf.

    operator: a key of OPERATORS, or "" for a temperature channel, "time", "column"; name: of the
    channel or column; constants: names, or numbers where they are bound.
    """

    operator: str
    inputs: tuple[Node, ...] = ()
    constants: tuple[str | float, ...] = ()
    name: str = ""

    @property
    def kind(self) -> Operator:
        """The operator; KeyError at a leaf."""
        return OPERATORS[self.operator]

    @property
    def is_leaf(self) -> bool:
        """Whether it is a recorded quantity itself."""
        return not self.inputs

    @property
    def depth(self) -> int:
        """How many operators stand above each other."""
        return 0 if self.is_leaf else 1 + max(n.depth for n in self.inputs)

    def walk(self) -> Iterator[Node]:
        """The node and all below it."""
        yield self
        for node in self.inputs:
            yield from node.walk()

    def channels(self) -> tuple[str, ...]:
        """The temperature channels that it reads, in order."""
        return tuple(dict.fromkeys(n.name for n in self.walk() if n.is_leaf and not n.operator))

    def columns(self) -> tuple[str, ...]:
        """The other recorded columns that it reads, in order."""
        return tuple(dict.fromkeys(n.name for n in self.walk() if n.operator == _COLUMN))

    def free(self) -> Iterator[tuple[str, Constant, Node]]:
        """The constants that are names: (name, what it is, the node that it belongs to)."""
        for node in self.walk():
            if node.is_leaf:
                continue
            for value, constant in zip(node.constants, node.kind.constants, strict=True):
                if isinstance(value, str):
                    yield value, constant, node

    def bound(self, values: Mapping[str, float]) -> Node:
        """The same with numbers for all names; KeyError where one is missing."""
        if self.is_leaf:
            return self
        return replace(
            self,
            inputs=tuple(n.bound(values) for n in self.inputs),
            constants=tuple(float(values[c]) if isinstance(c, str) else c for c in self.constants),
        )

    def simpler(self) -> Iterator[Node]:
        """Every formula with one operator less: a node replaced by one of its inputs."""
        yield from self.inputs
        for i, node in enumerate(self.inputs):
            for other in node.simpler():
                yield replace(self, inputs=(*self.inputs[:i], other, *self.inputs[i + 1 :]))

    def named(self) -> tuple[Node, dict[str, float]]:
        """The same with names for all numbers, and the numbers by those names."""
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
        """The formula as files hold it; `parse` reads it."""
        if self.operator == TIME:
            return TIME
        if self.operator == _COLUMN:
            return f'column("{self.name}")'
        if self.is_leaf:
            return self.name if self.name.isidentifier() else f'"{self.name}"'
        parts = [n.text() for n in self.inputs]
        parts += [c if isinstance(c, str) else repr(float(c)) for c in self.constants]
        return f"{self.operator}({', '.join(parts)})"

    # -- units ---------------------------------------------------------------------------------

    @property
    def is_celsius(self) -> bool:
        """Whether its values are temperatures, not differences or powers of them."""
        if self.is_leaf:
            return not self.operator
        return self.kind.keeps and self.inputs[0].is_celsius

    def unit(self) -> dict[str, int]:
        """Exponents of K, s and columns' own units in its values."""
        if self.operator == TIME:
            return {"s": 1}
        if self.operator == _COLUMN:
            return {self.name: 1}
        if self.is_leaf:
            return {"K": 1}
        total: dict[str, int] = {}
        for node in self.inputs:
            for name, power in node.unit().items():
                total[name] = total.get(name, 0) + power * self.kind.powers
        if self.kind.seconds:
            total["s"] = total.get("s", 0) + self.kind.seconds
        return {name: power for name, power in total.items() if power}

    def unit_of(self, constant: Constant) -> str:
        """The unit of one of its own constants."""
        if constant.role == "time_constant":
            return "s"
        if not constant.same_unit:
            return "rad" if constant.role == "phase" else "1"
        if constant.role == "threshold" and self.inputs[0].is_celsius:
            return _OFFSET_C
        return unit_text(self.inputs[0].unit())

    # -- words ---------------------------------------------------------------------------------

    def words(self, spoken: Mapping[str, str], reference: str = "temperature") -> str:
        """The formula as mathematics; spoken: {name of a constant: value in words}."""
        if self.operator == TIME:
            return "t"
        if self.is_leaf:
            return "T" if self.name == reference and not self.operator else self.name
        inner = [n.words(spoken, reference) for n in self.inputs]
        own = [spoken.get(str(c), f"{c:.4g}" if not isinstance(c, str) else c)
               for c in self.constants]  # fmt: skip
        return self.kind.words.format(*inner, *own)


def unit_text(powers: Mapping[str, int]) -> str:
    """A unit as files write it: K s, K2/s, 1."""
    up = [f"{n}{p if p > 1 else ''}" for n, p in powers.items() if p > 0]
    down = [f"{n}{-p if p < -1 else ''}" for n, p in powers.items() if p < 0]
    if not up and not down:
        return "1"
    return "/".join([" ".join(up) or "1", *down])


def parse(text: str) -> Node:
    """The tree of a formula. ConfigurationError says what cannot be read."""
    if len(text) > _LONGEST:
        raise ConfigurationError(f"a formula has at most {_LONGEST} characters: {text[:40]} …")
    try:
        tree = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ConfigurationError(f"formula {text!r} cannot be read") from error
    node = _node(tree, text, 0)
    names = [name for name, _, _ in node.free()]
    if len(set(names)) < len(names):
        raise ConfigurationError(f"formula {text!r}: each constant needs a name of its own")
    return node


def _node(tree: ast.expr, text: str, depth: int) -> Node:
    if depth > _DEEPEST:
        raise ConfigurationError(f"formula {text!r}: more than {_DEEPEST} operators in each other")
    if isinstance(tree, ast.Name):
        return Node(TIME) if tree.id == TIME else Node("", name=tree.id)
    if isinstance(tree, ast.Constant) and isinstance(tree.value, str):
        return Node("", name=tree.value)
    if not (isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name)) or tree.keywords:
        raise ConfigurationError(
            f"formula {text!r}: {ast.unparse(tree)!r} is not a recorded quantity; write a "
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
    inputs = tuple(_node(a, text, depth + 1) for a in arguments[: kind.inputs])
    constants = tuple(_constant(a, text) for a in arguments[kind.inputs :])
    return Node(name, inputs, constants)


def _constant(tree: ast.expr, text: str) -> str | float:
    if isinstance(tree, ast.Name):
        return tree.id
    sign = 1.0
    if isinstance(tree, ast.UnaryOp) and isinstance(tree.op, ast.USub):
        tree, sign = tree.operand, -1.0
    number = tree.value if isinstance(tree, ast.Constant) else None
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise ConfigurationError(
            f"formula {text!r}: {ast.unparse(tree)!r} is neither a number nor a name"
        )
    return sign * float(number)
