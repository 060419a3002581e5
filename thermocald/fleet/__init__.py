"""Many cameras: rows forwarded to a server, and what a whole fleet looks like."""
