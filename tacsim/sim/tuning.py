"""Tuned constants of the simulated reset.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: the tests in tests/tacsim/sim.
"""

# reset.py
APPROACH_GAP = 0.05e-3  # gap that an approach begins at [m]
FIRST_TOUCH_STEP = 0.01e-3  # its first step, beyond that gap: flat bodies then press with about 0.05 N [m]
MAX_STEP = 0.1e-3  # its longest [m]
TOUCH_TOLERANCE = 0.2  # the touch force may be exceeded by this fraction
