"""The simulated bench: one physical world, and instruments that observe it, served over real wires."""
