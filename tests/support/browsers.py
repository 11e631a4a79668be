"""The system's Chromium for tests of the panel, and a sentence on what these tests lack."""

import os
import shutil
from importlib.util import find_spec

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
NAMED = "BENCH_CHROMIUM"
PACKAGES = ("playwright", "axe_playwright_python")


def find_chromium(path: str | None = None) -> str:
    """Return the Chromium that BENCH_CHROMIUM names, else the first on `path` (None: PATH); "" if none."""
    named = os.environ.get(NAMED, "")
    if named:
        return shutil.which(named) or ""
    return next((found for name in NAMES if (found := shutil.which(name, path=path))), "")


def what_is_missing(path: str | None = None) -> str:
    """Return a sentence on what the tests in a browser lack; "" if nothing is missing."""
    lacking = [name for name in PACKAGES if find_spec(name) is None]
    if lacking:
        return f"the tests in a browser need {' and '.join(lacking)}: pip install 'triaxial-bench[browser]'"
    if not find_chromium(path):
        return (
            f"the tests in a browser drive the system's Chromium, and there is none of {', '.join(NAMES)} on the "
            f"path: install one (apt install chromium), or name it in {NAMED}"
        )
    return ""


if __name__ == "__main__":
    raise SystemExit(what_is_missing() or None)
