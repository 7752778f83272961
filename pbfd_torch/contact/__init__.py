"""Geometry of contact: shapes, obstacles with their signed distances, candidates, detection between bodies, and what detection may
have missed. No forces. Imports `tree` and `tensors`; forces are in `terms`."""
