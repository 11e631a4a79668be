"""Results: each with its model, of which JSON and schema come, its text, its page and its plots."""
