"""Fleets of cameras: forwarding to a server, overview, and reprocessing of archives."""
