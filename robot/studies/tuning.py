"""Tuned constants of simulations without a policy.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/physics.md, and the tests in
tests/robot/studies.
"""

# experiment.py
PEAK_PLACE = 0.7  # a trial continues beyond the goal until its peak is at this share of its curve
FINE_STEP_SHARE = 0.25  # factor on a step near the goal, so that no step passes the peak
# both ends of a reward curve must lie below its peak by more than this factor times the tolerance
MIN_REWARD_FALL = 5.0

# matched_press.py
RADIUS_TOLERANCE = 0.25  # contact radii that differ by less count as equal [px]
MAX_DEPTH_SHARE = 0.7  # of the gel's thickness; from 0.75 the elements under the ball are crushed, at any preset
MIN_DEPTH_MATCH = 0.97  # share of the maximum depth, and of a contact radius, that counts as reached
