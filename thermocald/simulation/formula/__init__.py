"""Formulas: a recorded quantity through operators, as text that is read and never executed."""
