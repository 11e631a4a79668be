"""The user's cache folder: what the bench writes outside of run folders and named places."""

from __future__ import annotations

from pathlib import Path


def cache_folder(part: str) -> Path:
    """Return the folder of a part of the cache; it need not exist yet."""
    import platformdirs

    return Path(platformdirs.user_cache_dir("triaxial-bench")) / part
