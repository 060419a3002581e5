"""A series reduced to small normal equations, and the hypotheses that are fitted to it."""

from __future__ import annotations
