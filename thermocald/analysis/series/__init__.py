"""The calibrated epochs of a series, and tests of drift."""
