"""What simulated SCPI instruments share: commands, values, status."""
