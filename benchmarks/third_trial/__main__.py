"""`python -m benchmarks.third_trial`; worker processes import `run`, not this module."""

from benchmarks.third_trial.run import main

if __name__ == "__main__":
    raise SystemExit(main())
