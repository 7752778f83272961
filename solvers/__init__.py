"""Solvers for nonlinear equations and energies: vectors in, vectors out; nothing of the simulator is imported here."""
