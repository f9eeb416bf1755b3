"""Tuned constants of what a person is led through at a rig.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/calibrate.md, docs/bringup.md,
and the tests in tests/robot/procedures.
"""

# ball_touches.py
MAX_LEFT_OUT = 0.5  # of the touches; with more, something is wrong with the set-up
MAX_RELEASED_DEPTH = 0.5  # of the depth of a touch; what is lifted and pressed so deep yet is not free

# presses.py
MIN_MOTION = 4.0  # a cell that changes by more is in motion [grey levels]
MIN_CONTACT_CHANGE = 8.0  # a cell that differs from the reference by more than the usual is touched [grey levels]
HOLD_TIME = 0.5  # [s] a picture that has not moved for so long stands still
