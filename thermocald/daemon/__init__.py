"""The daemon: what a configuration names, acquired, calibrated and kept, for months."""
