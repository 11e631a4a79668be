"""`python -m benchmarks.blind_trial`."""

import sys

from benchmarks.blind_trial.run import main

if __name__ == "__main__":
    sys.exit(main())
