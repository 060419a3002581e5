"""Parametrisations of which a part is quick."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def mostly_slow(values: Iterable[Any], *quick: Any) -> list[Any]:
    """Return all values of one argument, marked as slow but for the quick ones."""
    return [v if v in quick else pytest.param(v, marks=pytest.mark.slow) for v in values]
