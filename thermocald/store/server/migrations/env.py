"""Alembic's entry: runs the versions in this folder on the connection it was given."""

from alembic import context

if hasattr(context, "config"):  # else it is imported and not run, as by documentation
    connection = context.config.attributes["connection"]
    context.configure(connection=connection, transaction_per_migration=True)
    with context.begin_transaction():
        context.run_migrations()
