"""A discovery for people: figures and the report."""
