"""Photogrammetry: pure functions of arrays, and the immutable values they work on."""
