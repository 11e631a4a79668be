"""Files that people write: bench files, procedures, models; the instruments that they may name."""
