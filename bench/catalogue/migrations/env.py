"""How Alembic reaches the catalogue: by the connection, and in the transaction, of `bench.catalogue.store`."""

from alembic import context

from bench.catalogue.schema import METADATA

context.configure(connection=context.config.attributes["connection"], target_metadata=METADATA)
context.run_migrations()
