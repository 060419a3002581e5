"""Blind recordings in memory, and what discovery makes of them."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from tests.blind.bridge import series_input
from tests.blind.case import Case
from tests.blind.generator import generate
from thermocald.discovery.reduction import gather


@pytest.fixture
def evidence_of():
    """Evidence of M1 (and M2) of a blind case, and the truth."""

    def build(*effects: str, px: float = 0.3, seed: int = 1, **more):
        series, truth = generate(Case(effects, px, seed, **more))
        first = gather(series_input(series[0]))
        return [first, *(gather(series_input(s), first.T0, first.scale) for s in series[1:])], truth

    return build
