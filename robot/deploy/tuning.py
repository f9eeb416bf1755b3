"""Tuned constants of policies on a rig, and of the range of training.

Each entry: quantity, unit, and the measurement behind it, if there is one. Sources: docs/measurements/training.md,
and the tests in tests/robot/deploy.
"""

# training_range.py
MAX_FALSE_ALARMS = 0.03  # fraction of training episodes that may exceed the limit
ROUNDING = 1e-6  # of a scene's number, for rounding [fraction]
