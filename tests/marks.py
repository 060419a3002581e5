"""Parametrisations of which a part is quick."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def mostly_slow(values: Iterable[Any], *quick: Any) -> list[Any]:
    """Return all values of one argument, or tuples of several, as slow but for the quick ones."""
    return [
        v if v in quick
        else pytest.param(*v if isinstance(v, tuple) else (v,), marks=pytest.mark.slow)
        for v in values
    ]  # fmt: skip
