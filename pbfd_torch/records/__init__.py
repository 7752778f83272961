"""What a rollout was: states, contacts and how each step was solved, what the scene looks like, saved and loaded. Imports `scene`,
`integrators`, `looks` and what lies below; it makes no steps."""
