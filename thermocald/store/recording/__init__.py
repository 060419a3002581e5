"""A recording: the open folder format, read and written."""
