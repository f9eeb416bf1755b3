"""Tuned constants of the arm's driver and servo.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/decisions/0009, 0016 and 0020,
docs/reliability.md, and the tests in tests/robot/arm.
"""

# trajectory.py
# Rate of change of the speed scaling [1/s]: Universal Robots' ROS driver raises it by 0.01 in each period of 2 ms.
SCALING_RATE = 5.0
SLOW_LAG_RATIO = 1.5  # time constant of the model divided by that of servoJ
MAX_PACKAGE_GAP = 0.2  # between two packages; a larger or negative step is a jump of the controller's clock [s]
# of the controller's own target while ours is at rest [rad/s, rad]
OTHER_PROGRAM_SPEED, OTHER_PROGRAM_SHIFT = 2e-3, 1e-3
MAX_REST_SPEED, MAX_REST_TURN_RATE = 1e-3, 10e-3  # a slower arm is at rest [m/s, rad/s]
# from target to controller, joints behind their set points, package to worker [s]; added to the model's time constant
TARGET_DELAY = 10e-3

# servo.py
FAULT_DECELERATION = 5.0  # minimum deceleration after a fault [m/s^2]
FAULT_TURN_DECELERATION = 50.0  # the same for rotations [rad/s^2]
MAX_OVERSHOOT = 0.5e-3  # the arm itself may stop this far outside its region; the target never leaves it [m]
MAX_HELD_DISPLACEMENT, MAX_HELD_ROTATION = 0.2e-3, 2e-3  # beyond it an arm was pushed off its held pose [m, rad]
ZERO_REQUEST_TIMEOUT = 0.5  # an older request to zero the wrench is dropped [s]
MAX_STALL_PERIODS = 10  # periods that the target waits, after missed periods, for a newer package

# start_servo.py
JOINT_SPEED, JOINT_ACCELERATION = 0.1, 0.5  # of the fastest joint, at most [rad/s, rad/s^2]
OFF_PATH = 20e-3  # an arm with a joint farther than this from the path has left it [rad]

# driver.py
BRAKING_REACTION_TIME = 0.05  # from a picture that shows a touch to an arm that brakes [s]
