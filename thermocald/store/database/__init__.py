"""The store of a daemon, one SQLite file: its rows, columns, epochs and archive."""
