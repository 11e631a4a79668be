"""Check blocks: control charts with limits from stated u, and whether a run is accepted by them."""
