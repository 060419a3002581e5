"""Approximate orientation, and the identification of targets that rests on it."""
