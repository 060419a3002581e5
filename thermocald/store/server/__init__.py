"""The store of many stations: one PostgreSQL database, forwarded to and read by every analysis."""
