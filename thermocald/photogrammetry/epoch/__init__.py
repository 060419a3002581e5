"""Least-squares adjustment of one epoch and its diagnosis; measuring with a known camera."""
