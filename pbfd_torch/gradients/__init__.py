"""Derivatives of steps and of whole motions by the implicit function theorem, the scene's numbers by name, and linearised steps.
Built on steppers, whose steps it retraces; it never imports the simulator."""
