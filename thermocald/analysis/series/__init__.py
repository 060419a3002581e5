"""The table of a series, and whether the camera moved in it."""
