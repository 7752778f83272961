"""Trains controllers in the environments, by PPO and by the simulator's own gradients, and evaluates them elsewhere. Built on
`envs` and `conventional`."""
