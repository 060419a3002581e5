"""Blind recordings in memory, reduced for discovery."""

from __future__ import annotations

import os
from functools import cache

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest

from tests.blind.bridge import generated
from tests.blind.case import Case
from thermocald.discovery.result import discover_series
from thermocald.thermal.reduce import reduce_together


@pytest.fixture(scope="session")
def evidence_of():
    """Return a blind case's reduced series, M1 and perhaps M2, and its truth."""

    @cache
    def build(*effects: str, px: float = 0.3, seed: int = 1, **more):
        inputs, truth = generated(Case(effects, px, seed, **more))
        return reduce_together(inputs), truth

    return build


@pytest.fixture(scope="session")
def discovered(evidence_of):
    """Return what is discovered in a blind case, and its truth."""

    def discover(*effects: str, **case):
        evidence, truth = evidence_of(*effects, **case)
        return discover_series(evidence), truth

    return discover
