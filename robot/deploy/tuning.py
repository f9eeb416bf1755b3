"""Tuned constants of policies on a rig, and of the range of training.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/train.md, and the tests in
tests/robot/deploy.
"""

# training_range.py
MAX_FALSE_ALARMS = 0.03  # share of training's episodes that may be beyond the limit
MIN_DEVIATION = 0.01  # of a number in training: one that varies less counts as if it varied so much [encoded]
MIN_VARIANCE = 0.01  # of a direction, beside 1 of a number: smaller ones are noise
ROUNDING = 1e-6  # of a scene's number: what rounding leaves [share]
