"""Tuned constants of policies on a rig, and of the range of training.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/train.md, and the tests in
tests/robot/deploy.
"""

# training_range.py
MAX_FALSE_ALARMS = 0.03  # fraction of training episodes that may exceed the limit
ROUNDING = 1e-6  # of a scene's number, for rounding [fraction]
