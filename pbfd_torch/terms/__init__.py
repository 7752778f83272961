"""Physical effects, one a file: immutable objects that prepare a step and give a load on links or joints with its stiffness. A term
knows points, links and joints, not the tree's equations. Imports `contact`, `tree` and `tensors`; `balance` adds the loads up."""
