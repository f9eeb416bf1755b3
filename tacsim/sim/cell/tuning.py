"""Tuned constants of simulated cells.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: the tests in tests/tacsim/sim/cell.
"""

# ramp.py
# Share of a control period in which the speed changes: at 1, a change of speed would swing for ever; small ones shake
# what is held (at 0.3 and 20 mm/s, in 50 ms: 1.3 m/s^2)
RISE_SHARE = 0.3

# drives.py
HAND_MASS = 1e4  # of a free hand, which forces of grips then move by less than 1e-8 m a step [kg]
HAND_INERTIA = 1e2  # the same about each axis [kg m^2]
# Natural frequencies of the position control of joints and fingers, critically damped [rad/s]: 5 N at the tool of a
# UR5e move it by less than 0.1 mm, and steps of 2 ms are stable
ARM_FREQUENCY = 150.0
FINGER_FREQUENCY = 200.0
# Of the gears of fingers, over their mass [1/s], and the rate at which a grip force falls [N/s]. Without them a grip of
# 8 N that loosens to 0.5 N is thrown open by the gels, and drops an object of 30 g.
FINGER_DAMPING_RATE = 400.0
MAX_LOOSENING = 200.0
JOINT_TOLERANCE = 1e-9  # of poses that joints are found for [m, rad]
MAX_JOINT_STEPS = 200  # of Newton's method, at most

# cell.py
FALL_HEIGHT = 2e-3  # an object that falls so far, and that no pad touches on its way, has been dropped [m]

# resting.py
PEDESTAL_STIFFNESS = (1e4, 1e4, 1e4, 1.0, 1.0, 1.0)  # of what the object stands on, as springs [N/m, N m/rad]

# reset.py
CLOSING_SPEED = 20e-3  # of each finger towards the object [m/s]
LIFT_SPEED = 40e-3  # of the object [m/s]
OPEN_GAP = 2e-3  # between each pad and the object before a grip [m]
REST_SPEED = 0.2e-3  # an object slower than this rests [m/s]
REST_TURN = 20e-3  # the same for its rotation [rad/s]
MIN_REST_TIME = 0.03  # an object that rests for so long swings no more [s]
MAX_REST_TIME = 3.0  # longest wait for rest: a bar of 0.2 kg, held 14 mm off its centre, swings for 1.8 s [s]
GRIP_TOLERANCE = 0.02  # of the touch force, within which a grip has been reached
