"""The trial on records of real instruments: `python -m benchmarks.real_records`."""
