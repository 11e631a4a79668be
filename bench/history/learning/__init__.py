"""What the runs of one bench share, by restricted likelihood: sizes with u, and effects of the stand."""
