"""The catalogue as it was made first."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "certificates",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("number", sa.Text(), nullable=False),
        sa.Column("laboratory", sa.Text(), nullable=False),
        sa.Column("date", sa.Date(), nullable=False),
        sa.Column("valid_until", sa.Date(), nullable=True),
        sa.Column("serial", sa.Text(), nullable=True),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index(op.f("ix_certificates_number"), "certificates", ["number"], unique=False)
    op.create_table(
        "folders",
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("fingerprint", sa.Text(), nullable=False),
        sa.Column("run", sa.BigInteger(), nullable=True),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("vanished", sa.Boolean(), nullable=False),
        sa.PrimaryKeyConstraint("path"),
    )
    op.create_index(op.f("ix_folders_run"), "folders", ["run"], unique=False)
    op.create_table(
        "instruments",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("driver", sa.Text(), nullable=True),
        sa.Column("serial", sa.Text(), nullable=True),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index(op.f("ix_instruments_name"), "instruments", ["name"], unique=False)
    op.create_index(op.f("ix_instruments_serial"), "instruments", ["serial"], unique=False)
    op.create_table(
        "issued",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("register", sa.Text(), nullable=False),
        sa.Column("number", sa.Text(), nullable=False),
        sa.Column("time", sa.DateTime(), nullable=True),
        sa.Column("state", sa.Text(), nullable=False),
        sa.Column("by", sa.Text(), nullable=True),
        sa.Column("run", sa.Text(), nullable=True),
        sa.Column("head", sa.Text(), nullable=True),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index(op.f("ix_issued_head"), "issued", ["head"], unique=False)
    op.create_index(op.f("ix_issued_number"), "issued", ["number"], unique=False)
    op.create_index(op.f("ix_issued_register"), "issued", ["register"], unique=False)
    op.create_table(
        "runs",
        sa.Column("id", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("manifest_sha256", sa.Text(), nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("vanished", sa.Boolean(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("created", sa.DateTime(), nullable=True),
        sa.Column("ended", sa.DateTime(), nullable=True),
        sa.Column("imported", sa.Boolean(), nullable=False),
        sa.Column("simulated", sa.Boolean(), nullable=True),
        sa.Column("state", sa.Text(), nullable=False),
        sa.Column("procedure", sa.Text(), nullable=True),
        sa.Column("plan_hash", sa.Text(), nullable=True),
        sa.Column("operator", sa.Text(), nullable=True),
        sa.Column("unit_type", sa.Text(), nullable=True),
        sa.Column("serial", sa.Text(), nullable=True),
        sa.Column("unit", sa.Text(), nullable=True),
        sa.Column("bench", sa.Text(), nullable=True),
        sa.Column("bench_sha256", sa.Text(), nullable=True),
        sa.Column("temperature_c", sa.Float(), nullable=True),
        sa.Column("readings", sa.Integer(), nullable=False),
        sa.Column("program_version", sa.Text(), nullable=True),
        sa.Column("head", sa.Text(), nullable=True),
        sa.Column("events", sa.Integer(), nullable=False),
        sa.Column("record", sa.Text(), nullable=False),
        sa.Column("problem", sa.Text(), nullable=True),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("manifest_sha256"),
    )
    op.create_index(op.f("ix_runs_bench"), "runs", ["bench"], unique=False)
    op.create_index(op.f("ix_runs_created"), "runs", ["created"], unique=False)
    op.create_index(op.f("ix_runs_name"), "runs", ["name"], unique=False)
    op.create_index(op.f("ix_runs_path"), "runs", ["path"], unique=False)
    op.create_index(op.f("ix_runs_serial"), "runs", ["serial"], unique=False)
    op.create_index(op.f("ix_runs_unit"), "runs", ["unit"], unique=False)
    op.create_index("ix_runs_unit_created", "runs", ["unit", "created"], unique=False)
    op.create_table(
        "calibrations",
        sa.Column("run", sa.BigInteger(), nullable=False),
        sa.Column("of_record", sa.Boolean(), nullable=True),
        sa.Column("estimator", sa.Text(), nullable=True),
        sa.Column("model", sa.Text(), nullable=True),
        sa.Column("unit", sa.Text(), nullable=False),
        sa.Column("g_m_s2", sa.Float(), nullable=False),
        sa.Column("vector", sa.LargeBinary(), nullable=False),
        sa.Column("covariance", sa.LargeBinary(), nullable=False),
        sa.Column("u_meters", sa.LargeBinary(), nullable=True),
        sa.Column("sigma", sa.Float(), nullable=True),
        sa.Column("chi2", sa.Float(), nullable=True),
        sa.Column("dof", sa.Float(), nullable=True),
        sa.Column("p", sa.Float(), nullable=True),
        sa.Column("used", sa.Integer(), nullable=True),
        sa.ForeignKeyConstraint(["run"], ["runs.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("run"),
    )
    op.create_table(
        "diagnoses",
        sa.Column("run", sa.BigInteger(), nullable=False),
        sa.Column("verdict", sa.Text(), nullable=False),
        sa.Column("names", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["run"], ["runs.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("run"),
    )
    op.create_index(op.f("ix_diagnoses_verdict"), "diagnoses", ["verdict"], unique=False)
    op.create_table(
        "points",
        sa.Column("run", sa.BigInteger(), nullable=False),
        sa.Column("place", sa.Integer(), nullable=False),
        sa.Column("angle_deg", sa.Float(), nullable=True),
        sa.Column("delta_g", sa.Float(), nullable=False),
        sa.Column("u", sa.Float(), nullable=True),
        sa.Column("verdict", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["run"], ["runs.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("run", "place"),
    )
    op.create_table(
        "uses",
        sa.Column("run", sa.BigInteger(), nullable=False),
        sa.Column("role", sa.Text(), nullable=False),
        sa.Column("instrument", sa.BigInteger(), nullable=False),
        sa.Column("certificate", sa.BigInteger(), nullable=True),
        sa.Column("answered", sa.Text(), nullable=True),
        sa.Column("resource", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(["run"], ["runs.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("run", "role"),
    )
    op.create_index(op.f("ix_uses_certificate"), "uses", ["certificate"], unique=False)
    op.create_index(op.f("ix_uses_instrument"), "uses", ["instrument"], unique=False)
    op.create_table(
        "verifications",
        sa.Column("run", sa.BigInteger(), nullable=False),
        sa.Column("verdict", sa.Text(), nullable=False),
        sa.Column("limit_g", sa.Float(), nullable=True),
        sa.Column("rule", sa.Text(), nullable=True),
        sa.Column("worst_delta_g", sa.Float(), nullable=True),
        sa.Column("missing", sa.Integer(), nullable=True),
        sa.ForeignKeyConstraint(["run"], ["runs.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("run"),
    )
    op.create_index(op.f("ix_verifications_verdict"), "verifications", ["verdict"], unique=False)


def downgrade() -> None:
    """Remove the tables."""
    op.drop_index(op.f("ix_verifications_verdict"), table_name="verifications")
    op.drop_table("verifications")
    op.drop_index(op.f("ix_uses_instrument"), table_name="uses")
    op.drop_index(op.f("ix_uses_certificate"), table_name="uses")
    op.drop_table("uses")
    op.drop_table("points")
    op.drop_index(op.f("ix_diagnoses_verdict"), table_name="diagnoses")
    op.drop_table("diagnoses")
    op.drop_table("calibrations")
    op.drop_index("ix_runs_unit_created", table_name="runs")
    op.drop_index(op.f("ix_runs_unit"), table_name="runs")
    op.drop_index(op.f("ix_runs_serial"), table_name="runs")
    op.drop_index(op.f("ix_runs_path"), table_name="runs")
    op.drop_index(op.f("ix_runs_name"), table_name="runs")
    op.drop_index(op.f("ix_runs_created"), table_name="runs")
    op.drop_index(op.f("ix_runs_bench"), table_name="runs")
    op.drop_table("runs")
    op.drop_index(op.f("ix_issued_register"), table_name="issued")
    op.drop_index(op.f("ix_issued_number"), table_name="issued")
    op.drop_index(op.f("ix_issued_head"), table_name="issued")
    op.drop_table("issued")
    op.drop_index(op.f("ix_instruments_serial"), table_name="instruments")
    op.drop_index(op.f("ix_instruments_name"), table_name="instruments")
    op.drop_table("instruments")
    op.drop_index(op.f("ix_folders_run"), table_name="folders")
    op.drop_table("folders")
    op.drop_index(op.f("ix_certificates_number"), table_name="certificates")
    op.drop_table("certificates")
