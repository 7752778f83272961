"""The conventional formulation, to compare with: Newton–Euler equations with complementarity conditions for contact. Imports
`scene`, `records` and what lies below; it shares no step with `stepping`."""
