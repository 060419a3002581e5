"""Discovery's results for longer corpora: verdict, names, alternatives and gap, a line per case.

The blind cases are the twenty kinds of `single-0.1` with two seeds. The real ones are nine
effects hidden in the corners of each of four cameras, and a recording of each camera without one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.blind import score as blind_score
from tests.blind.case import SINGLE, Case
from tests.golden.compare import Bounds, differences
from tests.golden.workshop import EXPECTED
from tests.real_corners import score as real_score
from tests.real_corners.generator import CAMERAS, NINE, RealCase

BOUNDS = Bounds(1e-4, 1e-2, 1e-2)


def blind() -> Iterator[tuple[str, Case]]:
    """Yield forty cases and their names."""
    for seed in (60, 61):
        for effect in (*SINGLE, ""):
            yield f"{effect or 'none'} {seed}", Case((effect,) if effect else (), 0.1, seed)


def real() -> Iterator[tuple[str, RealCase]]:
    """Yield forty cases on real corners and their names."""
    for camera in CAMERAS:
        for effect in (*NINE, ""):
            case = RealCase(camera, (effect,) if effect else (), 500)
            yield f"{camera} {effect or 'none'}", case


CORPORA: dict[str, tuple[Callable[[], Iterator[tuple[str, Any]]], Any]] = {
    "blind": (blind, blind_score),
    "real-corners": (real, real_score),
}
"""For each name, the cases, and the module that discovers and scores them."""


def summarise(discovery: Any) -> dict[str, Any]:
    """Return verdict, names, alternatives, estimates and gap of one case."""
    document = discovery.as_dict()
    return {
        "verdict": document["verdict"],
        "effects": {
            e["effect"]: {
                "instead": [a["effect"] for a in e["alternatives"]],
                **{
                    k: {"value": v["value"], "sd": v["sd"]}
                    for k, v in e["estimates"].items()
                    if isinstance(v["value"], float) and v.get("sd") is not None
                },
            }
            for e in document["effects"]
        },
        "chi2": [document["gap"]["fit"]["before"]["chi2_reduced"],
                 document["gap"]["fit"]["after"]["chi2_reduced"]],
    }  # fmt: skip


def path(name: str) -> Path:
    return EXPECTED / f"corpus-{name}.jsonl"


def stored(name: str) -> dict[str, Any]:
    """Return the expected result of each case."""
    lines = path(name).read_text().splitlines() if path(name).exists() else []
    return {row.pop("case"): row for row in map(json.loads, lines)}


def check(name: str, update: bool = False) -> tuple[list[str], list[Any]]:
    """Return differences from the expected results, and outcomes; `update` stores new results."""
    cases, score = CORPORA[name]
    expected, found, wrong, outcomes = stored(name), {}, [], []
    for case_name, case in cases():
        discovery, truth, seconds = score.discover_case(case)
        outcomes.append(score.judge_discovery(case, discovery, truth, seconds))
        found[case_name] = json.loads(
            json.dumps(summarise(discovery)), parse_float=lambda t: float(f"{float(t):.9g}")
        )
        wrong += list(differences(expected.get(case_name), found[case_name], BOUNDS, case_name))
    if update:
        rows = [json.dumps({"case": c, **f}, separators=(",", ":")) for c, f in found.items()]
        path(name).write_text("\n".join(rows) + "\n")
    return wrong, outcomes
