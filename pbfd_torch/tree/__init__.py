"""The robot and how it moves: links and joints as tensors, the index tables that follow from the tree, rotations, forward
kinematics, what a body's mass may be. No forces. Imports `tensors` and `errors`; every room above may import it."""
