"""The simulated bench: one physical world, and instruments that look at it over real wires."""
