"""Tuned constants of simulations without a policy.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/physics.md, and the tests in
tests/robot/studies.
"""

# experiment.py
PEAK_PLACE = 0.7  # a trial goes on beyond the goal until its peak lies at this share of its curve
FINE_STEP_SHARE = 0.25  # share of a step that is taken near the goal, so that the peak is not stepped over
# both ends of a reward curve must lie more than this many times the distance allowed below its peak
MIN_REWARD_FALL = 5.0

# matched_press.py
RADIUS_TOLERANCE = 0.25  # the contact is as wide as the real one when its radius differs by no more [px]
MAX_DEPTH_SHARE = 0.7  # of the gel's thickness; from 0.75 the elements under the ball are crushed, at any preset
MIN_DEPTH_MATCH = 0.97  # of the deepest press, and of a contact's radius: then it is as good as that
