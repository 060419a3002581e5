"""Blind recordings in memory, reduced for discovery."""

from __future__ import annotations

import os
from functools import cache

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from tests.blind.bridge import series_input
from tests.blind.case import Case
from tests.blind.generator import generate
from thermocald.thermal.reduce import reduce_together


@pytest.fixture(scope="session")
def evidence_of():
    """Return a blind case's reduced series, M1 and perhaps M2, and its truth."""

    @cache
    def build(*effects: str, px: float = 0.3, seed: int = 1, **more):
        series, truth = generate(Case(effects, px, seed, **more))
        return reduce_together([series_input(s) for s in series]), truth

    return build
