"""What discovery says of longer corpora: a line a case, verdict, names, alternatives and gap.

The blind cases are the twenty kinds of `single-0.1` on three seeds, the real ones the nine effects
hidden in the corners of each of the four cameras, and a recording of each without one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from tests.blind.case import SINGLE, Case
from tests.blind.score import examine_case
from tests.golden.compare import Bounds, differences
from tests.golden.workshop import EXPECTED
from tests.real_corners.generator import CAMERAS, NINE, RealCase
from tests.real_corners.score import discovered

BOUNDS = Bounds(1e-4, 1e-2, 1e-2)


def blind() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Sixty cases: their names, and how to judge them."""
    for seed in (60, 61, 62):
        for effect in (*SINGLE, ""):
            case = Case((effect,) if effect else (), 0.1, seed)
            yield f"{effect or 'none'} {seed}", lambda case=case: examine_case(case)[0]


def real() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Forty cases on real corners."""
    for camera in CAMERAS:
        for effect in (*NINE, ""):
            case = RealCase(camera, (effect,) if effect else (), 500)
            yield f"{camera} {effect or 'none'}", lambda case=case: discovered(case)[0]


CORPORA = {"blind": blind, "real-corners": real}


def told(discovery: Any) -> dict[str, Any]:
    """Verdict, names, alternatives, estimates and the gap, of one case."""
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
    """What is expected of each case."""
    lines = path(name).read_text().splitlines() if path(name).exists() else []
    return {row.pop("case"): row for row in map(json.loads, lines)}


def check(name: str, update: bool = False) -> list[str]:
    """What is not as it is stored; with `update` it is stored as it is now."""
    expected, found, wrong = stored(name), {}, []
    for case, judge in CORPORA[name]():
        found[case] = json.loads(
            json.dumps(told(judge())), parse_float=lambda t: float(f"{float(t):.9g}")
        )
        wrong += list(differences(expected.get(case), found[case], BOUNDS, case))
    if update:
        rows = [json.dumps({"case": c, **f}, separators=(",", ":")) for c, f in found.items()]
        path(name).write_text("\n".join(rows) + "\n")
    return wrong
