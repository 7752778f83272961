"""One step of all worlds, without derivatives: what a stepper is, and the one in PyTorch, with its first solve, easier steps,
halving and start. Imports `scene`, `integrators`, `solvers` and what lies below. Another engine belongs beside it."""
