"""What a bench file says of each kind of instrument."""

from typing import Final

FOLDERS: Final = "BENCH_DEVICES"
"""The environment's name for folders of devices; here, where neither a form nor a driver comes with it."""
