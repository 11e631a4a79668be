"""Indexes that hold all that counting runs needs; those that they make needless go."""

from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

ADDED = (
    ("ix_runs_of_units", "runs", ["unit", "bench", "created", "simulated", "id"]),
    ("ix_runs_of_benches", "runs", ["bench", "unit", "created", "simulated", "id"]),
    ("ix_runs_of_operators", "runs", ["operator", "unit", "created", "simulated", "id"]),
    ("ix_verifications_verdict_run", "verifications", ["verdict", "run"]),
)
REMOVED = (
    ("ix_runs_unit", "runs", ["unit"]),
    ("ix_runs_bench", "runs", ["bench"]),
    ("ix_verifications_verdict", "verifications", ["verdict"]),
)


def upgrade() -> None:
    """Make the indexes."""
    for name, table, columns in ADDED:
        op.create_index(name, table, columns)
    for name, table, _columns in REMOVED:
        op.drop_index(name, table_name=table)


def downgrade() -> None:
    """Make those of before."""
    for name, table, columns in REMOVED:
        op.create_index(name, table, columns)
    for name, table, _columns in ADDED:
        op.drop_index(name, table_name=table)
