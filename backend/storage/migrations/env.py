"""Run by Alembic; `backend.storage.migrate` hands over the connection."""

from alembic import context
from sqlalchemy import Connection

from backend.storage.tables import Base

connection: Connection = context.config.attributes["connection"]
context.configure(
    connection=connection,
    target_metadata=Base.metadata,
    # SQLite can't alter most of a table: Alembic then copies it.
    render_as_batch=connection.dialect.name == "sqlite",
    transactional_ddl=True,
)
with context.begin_transaction():
    context.run_migrations()
