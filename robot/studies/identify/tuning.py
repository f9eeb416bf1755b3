"""Tuned constants of the simulated presses and squeezes that identify materials.

Each entry: quantity, unit, and the measurement behind it, if there is one. Sources:
docs/measurements/identification.md, and the tests in tests/robot/studies/identify.
"""

# identify.py
# [-] friction at which a body slips on a gel: a slipping body determines the friction, the force of a sticking one does
# not depend on it
FIRST_FRICTION = 0.25
FIRST_YIELD = 0.06  # of a body that the scene thinks elastic: where the fit begins, over its stiffness

# motions.py
PRESS_DEPTH, SLIDE_DEPTH = 0.25, 0.2  # of the gel's thickness
# of the body's height: how far it is closed, to squeeze it and to slide on it
SQUEEZE_SHARE, SLIDE_SQUEEZE_SHARE = 0.4, 0.12
BODY_SLIDE_SHARE = 0.5  # of its height: a step, a slide
# of the body's height: how far a tilted gel is pressed in, and goes back before it slides
TILT_DEPTH, TILT_RELEASE = 0.16, 0.06
# of its height: how far a tilted gel is slid along the other's face, and during the motion back
TILT_SLIDE, TILT_BACK = 0.3, 0.2
SLIDE, STEP = 2.0e-3, 0.1e-3  # how far a gel is slid, and in what steps it is pressed [m]
BODY_STEP = 0.04  # of its height: a step, a slide
