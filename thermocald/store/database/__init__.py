"""The store of a daemon: one SQLite file."""
