"""Tuned constants of what a person is led through at a rig.

Each entry: what it is, its unit, and what it was measured on where it was.
Sources: docs/calibrate.md, docs/hand-eye.md, and the tests in tests/robot/procedures.
"""

# presses.py
MAX_STILL_CHANGE = 4.0  # a cell with a larger change is in motion [grey levels]
MIN_CONTACT_CHANGE = 8.0  # a cell that differs more from the reference is touched [grey levels]
PRESS_REST_TIME = 0.5  # a picture without motion for this time stands still [s]
