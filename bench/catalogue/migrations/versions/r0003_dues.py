"""A table of when units are due, as it was reckoned."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Make the table."""
    op.create_table(
        "dues",
        sa.Column("unit", sa.Text(), nullable=False),
        sa.Column("asked", sa.Text(), nullable=False),
        sa.Column("told", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("unit", "asked"),
    )


def downgrade() -> None:
    """Take it away."""
    op.drop_table("dues")
