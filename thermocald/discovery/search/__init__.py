"""The search: candidates, their combinations, and what excludes them."""
