"""Multi-point tumbles in the words of IEEE Std 1293: each accelerometer by itself, with its nonlinear terms."""
