"""Tables and figure of the blind scoring."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.blind.case import OUTSIDE
from tests.blind.outcome import Outcome

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
        return f"{s[name]:.1%}" if np.isfinite(s[name]) else ""

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


REAL = "## Real corners"


def write(
    path: Path, found: dict[str, list[Outcome]], seeds: Sequence[int], partly: bool = False
) -> None:
    """Write the page of the documentation and its figure; partly: not all cases were run."""
    note = "Not all of its cases have been run yet: the table says how many.\n" if partly else ""
    power_figure(found, path.with_name(FIGURE))
    parts = "\n".join(row(p, o) for p, o in found.items())
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    kept = before[before.index(REAL) :] if REAL in before else ""  # scored by another command
    path.write_text(
        f"""# How well discovery names hidden effects

After this page you know how often a name that `discover` gives is right, and from what strength
on. The recordings come from a generator that shares no code with the program; their seeds were not
used while it was made.

```bash
{_command(found, seeds)}
```

writes this page, on one core; with `--store FILE` it can be interrupted and resumed. {note}

The number in a part's name is the strength of the effect: the RMS of the image residuals that the
fitted base model leaves, px. `hard`: irregular cadence, gaps, wrong coordinates, correlated noise,
people walking by, another heating programme in M2. `none2`: twice the thermometer's noise. `lists`:
the share in which alternatives that the data cannot exclude are listed too.

{HEAD}
{parts}

## Power

![Share of single effects named against their strength in px]({FIGURE})

Bars: 68 % confidence limits of the share.

## Wrong names

All other effects were named correctly, at every strength.

{confusion(found)}

{kept}""".rstrip()
        + "\n",
        encoding="utf-8",
    )


def _command(found: dict[str, list[Outcome]], seeds: Sequence[int]) -> str:
    return (
        f"python -m tests.blind.score --first {seeds[0]} --seeds {len(seeds)} "
        "--write docs/reference/discovery-confusion.md"
    )
