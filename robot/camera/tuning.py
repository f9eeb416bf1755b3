"""Tuned constants of the driver of cameras.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/decisions/0015,
docs/reliability.md, and the tests in tests/robot/camera.
"""

# camera.py
# Fraction of the values of a picture. With fewer changed values it is the same picture, except for a clock in its
# corner or hot pixels. In two films of a real gel at least 42 % differ between frames; a noise of 0.3 grey levels in a
# JPEG of quality 50 still changes 2.8 %.
MAX_SAME_IMAGE_CHANGE = 0.01
