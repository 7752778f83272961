"""The conventional formulation, to compare with: Newton–Euler equations with complementarity conditions for contact."""
