"""Tuned constants of simulations without a policy, and of those that identify materials.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/physics.md,
docs/measurements/identification.md, and the tests in tests/robot/studies.
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

# identify/identify.py
# [-] friction at which a body slips on a gel: a slipping body determines the friction, the force of a sticking one does
# not depend on it
FIRST_FRICTION = 0.25
FIRST_YIELD = 0.06  # start of the fit for a body that is elastic in the scene, over its stiffness

# identify/motions.py
PRESS_DEPTH, SLIDE_DEPTH = 0.25, 0.2  # of the gel's thickness
# of the body's height: compression in a squeeze, and in a slide
SQUEEZE_SHARE, SLIDE_SQUEEZE_SHARE = 0.4, 0.12
BODY_SLIDE_SHARE = 0.5  # of its height: a step, a slide
# of the body's height: depth of a tilted gel, and its release before it slides
TILT_DEPTH, TILT_RELEASE = 0.16, 0.06
# of its height: slide of a tilted gel along the other's face, and back
TILT_SLIDE, TILT_BACK = 0.3, 0.2
SLIDE, STEP = 2.0e-3, 0.1e-3  # length of a slide, and step of a press [m]
BODY_STEP = 0.04  # of its height: a step, a slide
