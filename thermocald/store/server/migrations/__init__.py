"""The server's tables, version by version, as Alembic runs them."""
