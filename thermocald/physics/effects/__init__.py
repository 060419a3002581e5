"""The effects that thermocald brings along, by their cause; `catalogue` finds them."""

from __future__ import annotations
