"""The state of a camera while it runs: filter, equilibrium, and the series in progress."""
