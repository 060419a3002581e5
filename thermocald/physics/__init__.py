"""Physics of a warming camera: effects, heat, models, and simulated recordings of them."""

from __future__ import annotations
