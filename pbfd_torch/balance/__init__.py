"""The balance of forces at the end of one step: loads of terms become the residual r and its exact Jacobian J, with what a search
may foresee of them, and the equations of motion as functions. Imports `terms`, `tree` and the solvers' protocols; it knows no
scene, no integrator and no history."""
