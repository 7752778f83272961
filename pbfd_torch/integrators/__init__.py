"""Schemes: the history that each keeps, the step that it makes of it, and how it starts. Imports `balance` and what lies below;
it solves nothing itself: `stepping` does."""
