"""Thermal calibration of low-cost cameras: live, with true standard deviations."""

__version__ = "0.1.0"
