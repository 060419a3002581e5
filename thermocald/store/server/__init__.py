"""The store of many stations: a PostgreSQL database that daemons forward to and analyses read."""
