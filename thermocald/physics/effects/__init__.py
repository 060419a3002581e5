"""The built-in effects, by their cause; `catalogue` finds them."""

from __future__ import annotations
