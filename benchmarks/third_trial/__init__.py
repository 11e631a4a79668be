"""The third trial of the diagnosis: geometry, effects, noise and mistakes written once more, apart from `bench`."""
