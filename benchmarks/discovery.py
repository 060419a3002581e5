"""Compare `discover` with peers on blind recordings: names, false alarms, gap on M2, time.

    python -m benchmarks.discovery [--seeds 1] [--px 0.1] [--long]

The peers get generous help: the free camera of each epoch whitened by its normal equations, the
smoothed temperature, and a library of all catalogue trajectories (non-linear parameters on a grid
around the true order of magnitude). They need `pip install pysindy scikit-learn`; a peer that is
not installed is reported and left out.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from dataclasses import dataclass, field

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from tests.blind.bridge import series_input
from tests.blind.case import SINGLE, Case
from tests.blind.generator import generate
from tests.blind.outcome import excess_closed
from thermocald.discovery.result import discover_series
from thermocald.discovery.search import list_candidates
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.reduce import reduce_series
from thermocald.thermal.series import COLUMNS, ReducedSeries

# The peers see parameter series only, which do not show effects in image space
COURSES = [e for e in SINGLE if e not in ("defocus", "target_displacement")]


@dataclass
class Score:
    right: int = 0
    cases: int = 0
    alarms: int = 0
    quiet: int = 0
    closed: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def library(fitter: HypothesisFitter, series: int) -> tuple[list[str], np.ndarray]:
    """Return names and whitened columns (E · D, K): each effect in each parameter it acts on."""
    e = fitter.series[series]
    names, columns = [], []
    base = fitter.drive_trajectory([], series)
    T = base - base.mean()
    for candidate in list_candidates(fitter.series):
        grid = (
            candidate.grid[:: max(len(candidate.grid) // 8, 1)] if len(candidate.grid) else [None]
        )
        for value in grid:
            if candidate.kind.is_event:
                trajectory = (e.times >= value).astype(float)
            elif candidate.kind.is_drive:
                trajectory = fitter.drive_trajectory([candidate.term(value, 1)], series) - base
            else:
                term = candidate.term(value, 1)
                trajectory = fitter.trajectories(term, series, operators=False)[0][:, 0]
            trajectory = trajectory - trajectory.mean()
            for parameter in candidate.parameters:
                names.append(candidate.effect)
                columns.append((trajectory, parameter))
    for parameter in ("c", "x0", "y0"):
        names.append("base")
        columns.append((T, parameter))
    root = whitening_root(e)
    X = np.stack([np.outer(c, root[COLUMNS.index(p)]).ravel() for c, p in columns], axis=1)
    return names, X


def whitening_root(series: ReducedSeries) -> np.ndarray:
    """Return a root (P, D) of the mean normal equations, without their weak directions."""
    size, U = np.linalg.eigh(series.N.mean(axis=0))
    keep = size > 1e-4 * np.median(size)
    return U[:, keep] * np.sqrt(size[keep])


def whitened(series: ReducedSeries) -> np.ndarray:
    return ((series.values - series.values.mean(axis=0)) @ whitening_root(series)).ravel()


def peer_sindy(X: np.ndarray, y: np.ndarray) -> np.ndarray:
    import pysindy

    # With columns of unit length, a term must explain a sixth of the misfit's amplitude
    optimizer = pysindy.STLSQ(
        threshold=float(np.linalg.norm(y)) / 6, alpha=1e-2, normalize_columns=True
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        optimizer.fit(X, y[:, None])
    return np.ravel(optimizer.coef_)


def peer_lasso(X: np.ndarray, y: np.ndarray) -> np.ndarray:
    from sklearn.linear_model import LassoLarsIC

    scale = np.linalg.norm(X, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = LassoLarsIC(criterion="bic", max_iter=60).fit(X / scale, y)
    return model.coef_ / scale


def named_effects(
    names: list[str], X: np.ndarray, coefficients: np.ndarray, y: np.ndarray
) -> set[str]:
    """Return the effects that explain more than noise, and a twentieth of the largest share."""
    power = {}
    for effect in set(names) - {"base"}:
        rows = [i for i, n in enumerate(names) if n == effect]
        power[effect] = float(np.sum((X[:, rows] @ coefficients[rows]) ** 2))
    top = max(power.values(), default=0.0)
    floor = max(0.05 * top, 3.0 * len(y) ** 0.5)
    return {e for e, p in power.items() if p > floor}


def gaussian_process(fitter: HypothesisFitter) -> float:
    """Return the share of M2's misfit that a discrepancy in (T, dT/dt) learnt on M1 explains."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, WhiteKernel

    data = []
    for s in (0, 1):
        e = fitter.series[s]
        T = fitter.drive_trajectory([], s)
        size, U = np.linalg.eigh(e.N.mean(axis=0))
        z = (e.values - e.values.mean(axis=0)) @ (U[:, -6:] * np.sqrt(size[-6:]))
        t = T - T.mean()
        z = z - np.outer(t, t @ z / (t @ t))
        data.append((np.column_stack([T - e.T0, 200 * np.gradient(T, e.times)]), z))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = GaussianProcessRegressor(RBF([5.0, 5.0]) + WhiteKernel(1.0), normalize_y=True)
        model.fit(*data[0])
        rest = data[1][1] - model.predict(data[1][0])
    rest = rest - rest.mean(axis=0)
    before, after = float(np.mean(data[1][1] ** 2)), float(np.mean(rest**2))
    return 1.0 - (after - 1.0) / max(before - 1.0, 1e-9)


def long_series() -> float:
    """Return the CPU time, s, for a day of 10 s epochs with a lag."""
    series, _ = generate(Case(("thermal_lag",), 0.1, 77, epochs=8640, with_m2=False))
    source = series_input(series[0])
    begin = time.process_time()
    found = discover_series([reduce_series(source)])
    assert [e.effect for e in found.effects] == ["thermal_lag"]
    return time.process_time() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--px", type=float, default=0.1)
    parser.add_argument(
        "--long", action="store_true", help="only the time for a day of 8,640 epochs"
    )
    a = parser.parse_args()
    if a.long:
        print(f"8640 epochs: {long_series():.1f} CPU s")
        return
    peers = {}
    for name, module, function in (
        ("pysindy STLSQ", "pysindy", peer_sindy),
        ("LassoLarsIC", "sklearn", peer_lasso),
    ):
        try:
            __import__(module)
            peers[name] = function
        except ImportError:
            print(f"{name}: left out; {module} is not installed")
    scores = {name: Score() for name in ("thermocald discover", *peers)}
    gp = []
    cases = [Case((e,), a.px, 500 + s) for s in range(a.seeds) for e in COURSES]
    cases += [Case((), a.px, 600 + s) for s in range(6 * a.seeds)]
    for case in cases:
        series, _ = generate(case)
        begin = time.process_time()
        first = reduce_series(series_input(series[0]))
        second = reduce_series(series_input(series[1]), first.T0, first.scale)
        found = discover_series([first, second])
        own = scores["thermocald discover"]
        own.seconds.append(time.process_time() - begin)
        _count(own, {e.effect for e in found.effects}, case)
        closed = excess_closed(found)
        if closed is not None:
            own.closed.append(closed)
        fitter = HypothesisFitter([first, second])
        prepared = [(library(fitter, s), whitened(fitter.series[s])) for s in (0, 1)]
        (names, X), y = prepared[0]
        for name, peer in peers.items():
            begin = time.process_time()
            coefficients = peer(*_without_base(names, X, y))
            scores[name].seconds.append(time.process_time() - begin)
            rest, _ = _without_base(names, X, y)
            _count(scores[name], named_effects(names, rest, coefficients, y), case)
            if case.effects:
                scores[name].closed.append(_closed(prepared[1], coefficients, names))
        if case.effects and "LassoLarsIC" in peers:
            gp.append(gaussian_process(fitter))
    print("| method | correct names | false alarms | gap on M2 closed (median) | median CPU s |")
    print("|---|---|---|---|---|")
    for name, s in scores.items():
        closed = f"{np.median(s.closed):.0%}" if s.closed else ""
        print(f"| {name} | {s.right} of {s.cases} | {s.alarms} of {s.quiet} | {closed} | "
              f"{np.median(s.seconds):.2f} |")  # fmt: skip
    if gp:
        print(f"| Gaussian process in (T, dT/dt) | names no effect | | {np.median(gp):.0%} | |")


def _without_base(names: list[str], X: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return library and misfit without the base model's terms, which helps the peers."""
    base = [i for i, n in enumerate(names) if n == "base"]
    Q, _ = np.linalg.qr(X[:, base])
    rest = X - Q @ (Q.T @ X)
    rest[:, base] = 0.0
    scale = np.linalg.norm(rest, axis=0)
    rest[:, scale < 1e-6 * scale.max()] = 0.0
    return rest + 1e-9 * np.random.default_rng(0).normal(size=rest.shape), y - Q @ (Q.T @ y)


def _closed(prepared: tuple, coefficients: np.ndarray, names: list[str]) -> float:
    """Return the share of M2's excess over the base model that the coefficients of M1 explain."""
    (own, X), y = prepared
    if own != names:
        return 0.0
    base = [i for i, n in enumerate(names) if n == "base"]
    B = X[:, base]
    before = y - B @ np.linalg.lstsq(B, y, rcond=None)[0]
    after = y - X @ coefficients
    after = after - B @ np.linalg.lstsq(B, after, rcond=None)[0]
    start = float(np.mean(before**2)) - 1.0
    return 1.0 - (float(np.mean(after**2)) - 1.0) / max(start, 1e-9)


def _count(score: Score, names: set[str], case: Case) -> None:
    if case.effects:
        score.cases += 1
        score.right += names == set(case.effects)
    else:
        score.quiet += 1
        score.alarms += bool(names)


if __name__ == "__main__":
    main()
