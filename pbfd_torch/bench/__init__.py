"""Measurements behind `pbfd bench`: what they time, and the error of what was timed."""
