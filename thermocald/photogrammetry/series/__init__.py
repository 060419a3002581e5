"""Adjustment of a whole series: parameters of the epochs and common unknowns."""
