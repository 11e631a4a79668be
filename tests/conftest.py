"""Makes the helpers that stand beside the tests importable by their bare names, whoever starts pytest."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
