"""The third trial of the diagnosis; its geometry, effects, noise and mistakes are independent of `bench`."""
