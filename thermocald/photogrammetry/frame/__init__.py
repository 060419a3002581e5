"""One frame: everything of the test field that it shows, measured and tracked."""
