"""The daemon: acquires, calibrates and stores the epochs of a configuration, for months."""
