"""Structures of tensors whose leading dimensions are worlds: some worlds of a batch, dataclasses full of tensors, products of small
vectors. It knows nothing of robots. Imports torch only; every room may import it, except `solvers`, which keeps to torch."""
