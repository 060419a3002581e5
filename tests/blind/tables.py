"""Tables and figure of the blind scoring."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np

from tests.blind.case import OUTSIDE
from tests.blind.outcome import Outcome
from thermocald.numbers import percent

HEAD = (
    "| part | cases | exact | exact or listed | lists | parameters within 3 sd | "
    "gap on M2 closed ≥ 90 % |\n|---|---|---|---|---|---|---|"
)
FIGURE = "discovery-power.svg"


def summary(outcomes: list[Outcome]) -> dict[str, float]:
    pulls = [abs(p) for o in outcomes for p in o.pulls.values()]
    closed = [o.gap_closed for o in outcomes if o.gap_closed is not None]
    return {
        "cases": len(outcomes),
        "exact": float(np.mean([o.right for o in outcomes])),
        "exact_or_listed": float(np.mean([o.right_or_listed for o in outcomes])),
        "lists": float(np.mean([bool(o.listed) for o in outcomes])),
        "within_3_sd": float(np.mean([p <= 3 for p in pulls])) if pulls else float("nan"),
        "gap_closed_90": float(np.mean([c >= 0.9 for c in closed])) if closed else float("nan"),
    }


def row(part: str, outcomes: list[Outcome]) -> str:
    """Return one line of the table."""
    s = summary(outcomes)

    def share(name: str) -> str:
        return percent(s[name]) if np.isfinite(s[name]) else ""

    return (f"| {part} | {s['cases']:.0f} | {share('exact')} | {share('exact_or_listed')} | "
            f"{share('lists')} | {share('within_3_sd')} | {share('gap_closed_90')} |")  # fmt: skip


def confusion(found: dict[str, list[Outcome]]) -> str:
    """Return a table of the wrong names: a line for each effect that was not named correctly."""
    lines = ["| part | hidden | right | named instead |", "|---|---|---|---|"]
    for part, outcomes in found.items():
        rows: dict[str, Counter[str]] = {}
        for o in outcomes:
            name = "+".join(o.case.effects) or "none"
            rows.setdefault(name, Counter())["+".join(o.found) or "none"] += 1
        for name, given in rows.items():
            own = "unnamed" if name == OUTSIDE else "+".join(sorted(name.split("+")))
            wrong = ", ".join(f"{c} × {n}" for c, n in sorted(given.items()) if c != own)
            if wrong:
                lines.append(f"| {part} | `{name}` | {given[own]} of {given.total()} | {wrong} |")
    return "\n".join(lines)


def power_figure(found: dict[str, list[Outcome]], path: Path) -> None:
    """Plot the shares of correct and wrong names of single effects against strength, px."""
    import matplotlib as mpl

    mpl.use("svg")
    from matplotlib import pyplot as plt

    parts = sorted((p for p in found if p.startswith("single-")), key=_strength)
    px = [_strength(p) for p in parts]
    n = np.array([len(found[p]) for p in parts])
    right = np.array([np.mean([o.right for o in found[p]]) for p in parts])
    wrong = np.array([np.mean([bool(o.found) and not o.right for o in found[p]]) for p in parts])
    with mpl.rc_context({"svg.hashsalt": "power"}):
        figure, axes = plt.subplots(figsize=(6.4, 3.6))
        for share, label, colour in (
            (right, "exact name", "#1b6ca8"),
            (wrong, "another name, or unnamed", "#b8442a"),
        ):
            low, high = _interval(share, n)
            axes.errorbar(px, 100 * share, 100 * np.array([share - low, high - share]),
                          fmt="o-", color=colour, label=label, capsize=3)  # fmt: skip
        axes.set(xscale="log", ylim=(-3, 103), xlabel="strength / px RMS left by the base model",
                 ylabel="share of single effects / %")  # fmt: skip
        axes.set_xticks(px, [f"{v:g}" for v in px])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend()
        figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
        plt.close(figure)


def _strength(part: str) -> float:
    return float(part.partition("-")[2])


def _interval(share: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 68 % limits of a share (Wilson 1927)."""
    middle = (share + 0.5 / n) / (1 + 1 / n)
    half = np.sqrt(share * (1 - share) / n + 0.25 / n**2) / (1 + 1 / n)
    return np.minimum(middle - half, share), np.maximum(middle + half, share)


def write(path: Path, found: dict[str, list[Outcome]]) -> None:
    """Write the tables of the documentation's page anew, and its figure."""
    power_figure(found, path.with_name(FIGURE))
    parts = "\n".join([HEAD, *(row(p, o) for p, o in found.items())])
    text = path.read_text(encoding="utf-8")
    for table in (parts, confusion(found)):
        head = re.escape(table.partition("\n")[0])
        text = re.sub(rf"{head}(\n\|.*)*", lambda _, table=table: table, text)
    path.write_text(text, encoding="utf-8")
