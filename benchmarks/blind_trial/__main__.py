"""`python -m benchmarks.blind_trial`."""

import os
import sys

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the matrices are small: threads only get in each other's way

from benchmarks.blind_trial.run import main

if __name__ == "__main__":
    sys.exit(main())
