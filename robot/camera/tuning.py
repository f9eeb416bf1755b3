"""Tuned constants of the driver of cameras.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/decisions/0015,
docs/reliability.md, and the tests in tests/robot/camera.
"""

# camera.py
# Of the values of a picture. What differs in fewer is the same picture, but for a clock in its corner or hot pixels. In
# two films of a real gel at least 42 % differ from one frame to the next; a noise of 0.3 grey levels in a JPEG of
# quality 50 still changes 2.8 %.
MIN_CHANGED_SHARE = 0.01
