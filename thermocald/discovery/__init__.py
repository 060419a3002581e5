"""Discovery: where simulation and measurement disagree, and the name of the missing effect."""
