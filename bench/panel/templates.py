"""The pages of the panel, as templates."""
