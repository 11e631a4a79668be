"""Programs that the panel starts: they live on by themselves, whatever becomes of the panel."""
