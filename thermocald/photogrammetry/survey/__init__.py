"""The survey of a test field, from photographs to coordinates."""
