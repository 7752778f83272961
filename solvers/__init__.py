"""Solvers for nonlinear equations and energies: vectors in, vectors out. Imports torch only, nothing of ours; `balance` gives it
problems, and `stepping` composes it."""
