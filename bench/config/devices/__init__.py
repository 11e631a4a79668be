"""What a bench file says of each kind of instrument."""

from contextvars import ContextVar
from typing import Final

FOLDERS: Final = "BENCH_DEVICES"
"""The environment variable that lists folders of devices; defined here, so that its import loads no driver."""
devices_given: ContextVar[tuple[str, ...]] = ContextVar("devices_given", default=())
"""The folders that `--devices` names, as they were typed."""
