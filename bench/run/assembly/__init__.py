"""Where instruments are put together: drivers, and the simulated bench behind them."""
