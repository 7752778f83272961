"""Measurements behind `pbfd bench`: what they time, and the error of what was timed. Imports the simulator, the named scenes and
`conventional`; only `cli` imports it."""
