"""The search for a formula: a library on a grid, then exact constants, then further operators.

Formulas are scored like the catalogue's effects (`search`), by the gain in χ² less

    coefficients · ln n + constants · ln n + 2 ln(trials) + margin,

where n is the number of epochs and trials the number of formulas tried.

The library holds the formulas that are tried first, on a grid of constants, and extends them by one
operator:

    recorded quantity → memory (lag, play, …) → shape (power, threshold, …) → memory (integral, …)

The grids follow the recording: thresholds are within its range, time constants within its duration.

The search runs on condensed evidence. The likelihood of the base model is a quadratic form in any
further trajectory of the camera's parameters. On rows of neighbouring epochs, with levels and the
base's own rates eliminated, its matrix has a few hundred rows. Its root whitens trajectories and
data once, so that thousands of candidates take milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.discovery.criteria import MARGIN
from thermocald.physics.formula import TIME, Evaluator, Node
from thermocald.physics.history import History
from thermocald.physics.operators import OPERATORS
from thermocald.thermal.scan import normals_beside
from thermocald.thermal.series import unit_directions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array
    from thermocald.physics.operators import Constant
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.likelihood import Weighting

_ROWS = 90  # per series
_KNOTS = 400
_NULL = 1e-9  # share of the largest eigenvalue: below are levels and the base's own rates


@dataclass(frozen=True, eq=False)
class Condensed:
    """Series condensed to few rows and whitened.

    histories: one per series, at the rows' times; edges: the first row of each series, and the
    number of rows; root (k, rows, r): whitens trajectories of each parameter; data (r,), whitened;
    amplitude (k, rows): the data's own trajectories, px-scaled; epochs: number in all series.
    """

    histories: tuple[History, ...]
    edges: tuple[int, ...]
    root: Array
    data: Array
    amplitude: Array
    epochs: int

    def gains(self, trajectories: Array) -> Array:
        """Return the χ² (G,) that trajectories (rows, G) explain, each in all parameters."""
        return np.asarray(np.sum((self.regressors(trajectories) @ self.data) ** 2, axis=1))

    def whitened(self, trajectories: Array) -> Array:
        """Whiten trajectories (rows, G) in each parameter: (G, k, r)."""
        s = trajectories - trajectories.mean(axis=0)
        return np.stack([s.T @ part for part in self.root], axis=1)

    def regressors(self, trajectories: Array) -> Array:
        """Return orthonormal whitened regressors (G, k, r) of trajectories (rows, G)."""
        s = trajectories - trajectories.mean(axis=0)
        Z = self.whitened(s / np.maximum(np.abs(s).max(axis=0), 1e-300))
        Z /= np.maximum(np.linalg.norm(Z, axis=2, keepdims=True), 1e-9)
        own = Z @ np.swapaxes(Z, 1, 2) + 1e-7 * np.eye(Z.shape[1])
        return np.asarray(np.linalg.inv(np.linalg.cholesky(own)) @ Z)

    @property
    def power(self) -> float:
        """The χ² of all that the base model leaves in these parameters."""
        return float(self.data @ self.data)

    def surrogates(self, count: int, rng: np.random.Generator) -> Array:
        """Draw whitened data (r, count) with trajectories moved in time against the recording.

        Each series' are shifted cyclically, half of them reversed, and half inverted in sign. They
        are as smooth as the misfit, but their cause was not recorded.
        """
        out = np.zeros((len(self.data), count))
        for i in range(count):
            moved = np.empty_like(self.amplitude)
            for begin, end in zip(self.edges[:-1], self.edges[1:], strict=True):
                n = end - begin
                part = np.roll(self.amplitude[:, begin:end], rng.integers(n // 8, n - n // 8), 1)
                part = part[:, ::-1] if rng.random() < 0.5 else part
                moved[:, begin:end] = part if rng.random() < 0.5 else -part
            out[:, i] = np.einsum("ker,ke->r", self.root, moved)
        return out


def condense(
    fitter: HypothesisFitter,
    fit: Fit,
    parameters: Sequence[str],
    weightings: Sequence[Weighting] | None = None,
) -> Condensed:
    """Condense the evidence of all series on some parameters, beside a fitted hypothesis.

    weightings: covariances of another hypothesis whose reading errors are closer to the truth.
    """
    k, directions = len(parameters), unit_directions(parameters)
    pools, histories = [], []
    for e in fitter.series:
        # the epochs of each row (E, m), and the history at the rows' mean times, on some knots
        group = np.arange(len(e.times)) // int(np.ceil(len(e.times) / _ROWS))
        pool = (group[:, None] == np.arange(group[-1] + 1)).astype(float)
        h = e.history
        knots = h.polygon().times
        knots = knots[:: int(np.ceil(len(knots) / _KNOTS))]
        readings = {name: h.polygon(name).at(knots) for name in h.readings}
        times = (e.times @ pool) / pool.sum(axis=0)
        pools.append(pool)
        histories.append(History(times, knots, readings, h.reference, h.T0, h.columns))
    counts = [p.shape[1] for p in pools]
    edges = np.concatenate([[0], np.cumsum(counts)])
    rows = int(edges[-1])
    place = np.arange(k * rows).reshape(k, rows)
    further = [
        (np.tile(pool, k), np.repeat(directions, m, axis=1), place[:, begin : begin + m].ravel())
        for pool, m, begin in zip(pools, counts, edges, strict=False)
    ]
    Q, y = normals_beside(fit, further, k * rows, weightings)
    size, U = np.linalg.eigh(0.5 * (Q + Q.T))
    kept = size > _NULL * size[-1]
    size, U = size[kept], U[:, kept]
    held = 0.1 * float(np.median(size))
    amplitude = U @ (U.T @ y / (size + held))
    return Condensed(
        tuple(histories),
        tuple(int(i) for i in edges),
        (U * np.sqrt(size)).reshape(k, rows, -1),
        U.T @ y / np.sqrt(size),
        amplitude.reshape(k, rows),
        sum(int((e.n > 0).sum()) for e in fitter.series),
    )


class Library:
    """The formulas of the quantities that all histories hold."""

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
        """Return the trajectory (rows,) of a bound formula, all histories concatenated."""
        return np.concatenate([e.values(node) for e in self.evaluators])

    def span(self, node: Node) -> tuple[float, float]:
        """Return the range of a formula's values."""
        v = self.values(node)
        return float(v.min()), float(v.max())

    # -- first tries -----------------------------------------------------------------------------

    def first(self) -> list[Node]:
        """List the formulas that are tried first."""
        out: list[Node] = []
        for leaf in self.leaves:
            for inner in self.with_memory(leaf):
                out += [inner, *self.shapes(inner)]
            low, high = self.span(leaf)
            for P in (high - low) * np.array([0.2, 0.3, 0.45, 0.7]):  # as from interference
                out += [_apply("wave", leaf, P, phi) for phi in np.arange(4) * np.pi / 4]
            smooth = [_apply("lag", leaf, tau) for tau in self.taus[1:5]]
            for rated in (_apply("rate", n) for n in (leaf, *smooth)):
                out += [rated, *self.shapes(rated, about_zero=True)]
            changed = _apply("change", leaf)
            out += [_apply(n, changed) for n in ("square", "cube", "magnitude", "signed_square")]
            out.append(_apply("product", changed, Node(TIME)))
            for shape in (*self.offsets(leaf), *self.shapes(leaf)):
                out += self.with_memory(shape, few=True)
                out.append(_apply("integral", shape))
        out += self.products()
        return _keep_distinct(out)

    def with_memory(self, node: Node, few: bool = False) -> list[Node]:
        """Apply each operator with memory to a quantity."""
        low, high = self.span(node)
        out = [] if few else [node]
        taus = self.taus[::2] if few else self.taus
        out += [_apply("lag", node, tau) for tau in taus]
        out += [_apply("maximum", node)]
        if few:
            return out
        out += [_apply("lag", _apply("lag", node, tau), tau) for tau in taus[:-1]]
        out += [_apply("play", node, r) for r in (high - low) * np.geomspace(0.04, 0.35, 5)]
        out += [_apply("minimum", node)]
        out += [_apply("peak", node, tau) for tau in taus[1:]]
        return out

    def offsets(self, node: Node, few: bool = False) -> list[Node]:
        """Shift a quantity's origin."""
        low, high = self.span(node)
        width = high - low
        far = low + width * np.array([-3.0, -1.0, -0.2, 0.5, 1.2, 2.0, 4.0])
        places = far if few else np.linspace(low - 0.5 * width, high + 0.5 * width, 9)
        return [_apply("offset", node, a) for a in places]

    def shapes(self, node: Node, about_zero: bool = False) -> list[Node]:
        """Apply each pointwise operator to a quantity."""
        low, high = self.span(node)
        width = max(high - low, 1e-12)
        inside = np.linspace(low, high, 11)[1:-1]
        out = [_apply("above", node, k) for k in inside]
        out += [
            _apply("saturation", node, k, w * width)
            for k in inside[::2]
            for w in (0.01, 0.08, 0.25)
        ]
        if about_zero:
            names = ("square", "signed_square", "magnitude", "cube")
            return out + [_apply(name, node) for name in names]
        middle = _apply("offset", node, 0.5 * (low + high))
        out += [_apply("square", middle), _apply("cube", middle), _apply("magnitude", middle)]
        out += [
            _apply("power", _apply("above", node, k), p)
            for k in (low - 0.02 * width, *inside[1:6:2])
            for p in (0.5, 2.0, 3.0)
        ]
        out += [_apply("exponential", node, w * width) for w in (0.12, 0.4)]
        return out

    def products(self) -> list[Node]:
        """List products of two quantities."""
        time, out = Node(TIME), [_apply("square", Node(TIME)), _apply("power", Node(TIME), 0.5)]
        for i, leaf in enumerate(self.leaves):
            for offset in self.offsets(leaf, few=True):
                out.append(_apply("product", offset, time))
                others = [n for n in self.leaves if n != leaf]
                out += [_apply("product", offset, n) for n in others]
                out += [_apply("product", offset, _apply("rate", n)) for n in self.leaves]
            out += [
                _apply("product", _apply("rate", leaf), _apply("rate", n))
                for n in self.leaves[i + 1 :]
            ]
        return out

    # -- one step further --------------------------------------------------------------------------

    def further(self, node: Node) -> list[Node]:
        """Add one operator to a formula: outside, at one of its quantities, or as a factor."""
        out = [*self.with_memory(node)[1:], _apply("rate", node), _apply("integral", node)]
        out += self.shapes(node)
        out += [_apply("product", o, node) for leaf in self.leaves
                for o in self.offsets(leaf, few=True)]  # fmt: skip
        out.append(_apply("product", node, Node(TIME)))
        for leaf in {n for n in node.walk() if n.is_leaf and n.operator != TIME}:
            out += [_replace_leaf(node, leaf, inner) for inner in self.with_memory(leaf)[1:]]
            out += [_replace_leaf(node, leaf, other) for other in self.leaves if other != leaf]
        deepest = max(node.depth, 4)
        return [n for n in _keep_distinct(out) if n.depth <= deepest]


def _apply(operator: str, *parts: Node | float) -> Node:
    count = OPERATORS[operator].inputs
    inputs = tuple(p for p in parts[:count] if isinstance(p, Node))
    return Node(operator, inputs, tuple(float(p) for p in parts[count:] if not isinstance(p, Node)))


def _replace_leaf(node: Node, leaf: Node, by: Node) -> Node:
    if node == leaf:
        return by
    return replace(node, inputs=tuple(_replace_leaf(n, leaf, by) for n in node.inputs))


def _keep_distinct(nodes: Sequence[Node]) -> list[Node]:
    """Remove duplicates and bare thermometers, which the catalogue covers."""
    return [n for n in dict.fromkeys(nodes) if n.inputs or n.operator]


_WIDTH = 16  # structures whose constants are fitted exactly
_KEPT = 800  # formulas of a library that are tried again with other covariances
_FURTHER = 3  # formulas that are extended by an operator
_STEPS = 2  # extensions
_ITERATIONS = 6
_SIMPLER = 0.25  # log of the misfit: one more operator must leave a quarter less


@dataclass(frozen=True, eq=False)
class Found:
    """A formula with its constants, the χ² it explains, the search's penalty, and its rank."""

    node: Node
    gain: float
    penalty: float
    rank: float


class FormulaSearch:
    """A search for formulas of the quantities that some series recorded."""

    def __init__(self, evidence: Condensed, before: FormulaSearch | None = None) -> None:
        """Evaluate the library; before: a search in the same series with other covariances, of
        which only the best formulas are tried again.
        """
        self.evidence = evidence
        if before is None:
            self.library = Library(evidence.histories)
            self.nodes = self.library.first()
            self.tried = len(self.nodes)
            self.nodes, self.stack = self._keep_finite(self.nodes)
        else:
            self.library, self.tried = before.library, before.tried
            kept = np.sort(np.argsort(-before.gains)[:_KEPT])
            self.nodes, self.stack = [before.nodes[i] for i in kept], before.stack[:, kept]
        self.regressors = evidence.regressors(self.stack)
        self.gains: Array = np.sum((self.regressors @ evidence.data) ** 2, axis=1)

    def _keep_finite(self, nodes: Sequence[Node]) -> tuple[list[Node], Array]:
        """Return the formulas that are finite and vary, and their trajectories (rows, G)."""
        with np.errstate(all="ignore"):
            stack = np.stack([self.library.values(n) for n in nodes], axis=1)
            good = np.isfinite(stack).all(axis=0) & (np.ptp(stack, axis=0) > 0)
        return [n for n, ok in zip(nodes, good, strict=True) if ok], stack[:, good]

    def best(self, further: bool) -> list[Found]:
        """Rank formulas, best first, each structure once; further: also extend them."""
        ranking = self._fit_structures(self.nodes, self.gains, _WIDTH)
        for _ in range(_STEPS if further else 0):
            if self._left(ranking[0].gain) < 0.5 * len(self.evidence.data):
                break
            more: list[Node] = []
            for one in ranking[:_FURTHER]:
                more += self.library.further(one.node)
            before = ranking[0]
            self.tried += len(more)
            kept, stack = self._keep_finite(more)
            tried = self._fit_structures(kept, self.evidence.gains(stack), _WIDTH // 2)
            ranking = sorted([*ranking, *tried], key=lambda f: f.rank, reverse=True)
            if ranking[0].rank <= before.rank:
                break
        return ranking

    def _rank(self, node: Node, gain: float) -> float:
        """Return the rank, from the misfit left; a further operator must leave a quarter less."""
        return -float(np.log(self._left(gain))) - _SIMPLER * node.size

    def _fit_structures(self, nodes: Sequence[Node], gains: Array, width: int) -> list[Found]:
        """Fit the constants of the best `width` structures of some formulas."""
        ranks = [-self._rank(n, float(g)) for n, g in zip(nodes, gains, strict=True)]
        order = np.argsort(ranks)
        seen: dict[Node, Node] = {}
        for i in order:
            structure = nodes[i].named()[0]
            if structure not in seen:
                seen[structure] = nodes[i]
            if len(seen) == width:
                break
        out = [self._refine(node) for node in seen.values()]
        return sorted(out, key=lambda f: f.rank, reverse=True)

    def _refine(self, node: Node) -> Found:
        """Find the constants that explain most, by Gauss-Newton with coefficients eliminated."""
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
        n = np.log(self.evidence.epochs)
        penalty = (len(self.evidence.root) + len(x)) * n + 2 * np.log(max(self.tried, 1))
        return Found(at(x), gain, float(penalty + MARGIN), self._rank(at(x), gain))

    def _newton(self, trajectory: Array, slopes: Array) -> Array:
        """Return the step of the constants (n,), in the units of `slopes` (rows, n)."""
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
        """Return a step of a constant that changes the formula's values slightly."""
        if constant.positive or constant.role == "phase":
            return 0.05 * max(abs(value), 1.0 if constant.role == "phase" else 0.0)
        low, high = self.library.span(owner.inputs[0])
        return 0.03 * (high - low)

    def _limits(self, owner: Node, constant: Constant) -> tuple[float, float]:
        """Return a constant's limits; a threshold is near the range of its operator's input."""
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
        """Return the χ² left beyond the noise, always positive."""
        r = len(self.evidence.data)
        return max(self.evidence.power - gain - r, 0.0) + 0.1 * r

    def surrogates(self, count: int, rng: np.random.Generator) -> tuple[float, Array]:
        """Return the largest share of the misfit a formula explains, in data and in surrogates."""
        data = self.evidence.surrogates(count, rng)
        power = np.maximum(np.sum(data**2, axis=0), 1e-300)
        G, k, r = self.regressors.shape
        every = self.regressors.reshape(G * k, r) @ np.column_stack([data, self.evidence.data])
        top = (every**2).reshape(G, k, -1).sum(axis=1).max(axis=0)
        return float(top[-1] / self.evidence.power), top[:-1] / power
