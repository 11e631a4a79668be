"""What a bench file says of each kind of instrument."""

from typing import Final

FOLDERS: Final = "BENCH_DEVICES"
"""The environment variable that lists folders of devices; defined here, so that its import loads no driver."""
