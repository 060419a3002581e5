"""A whole series adjusted together: epochs and their common unknowns."""
