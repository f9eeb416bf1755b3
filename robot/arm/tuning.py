"""Tuned constants of the arm's driver and servo.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/decisions/0009, 0016 and 0020,
docs/reliability.md, and the tests in tests/robot/arm.
"""

# following.py
# How fast the speed scaling changes [1/s]: Universal Robots' ROS driver lets it rise by 0.01 in each period of 2 ms.
SCALING_RATE = 5.0
MODEL_LAG = 1.5  # [time constants of servoJ] of the model of an arm that follows its target
TARGET_DELAY = 10e-3  # added to it: target to controller, joints behind their set points, package to worker [s]
MAX_PACKAGE_GAP = 0.2  # between two packages; a larger step, or one back, is a jump of the controller's clock [s]
# of the controller's own target, where servoJ would let it rest [rad/s, rad]
MAX_FOREIGN_SPEED, MAX_FOREIGN_SHIFT = 2e-3, 1e-3
MAX_REST_SPEED, MAX_REST_TURN_RATE = 1e-3, 10e-3  # an arm slower than this is at rest [m/s, rad/s]

# servo.py
FAULT_DECELERATION = 5.0  # minimum deceleration after a fault [m/s^2]
FAULT_TURN_DECELERATION = 50.0  # the same for rotations [rad/s^2]
MAX_OVERSHOOT = 0.5e-3  # how far outside its region the arm itself may come to rest; the target never leaves it [m]
MAX_HELD_SHIFT, MAX_HELD_TURN = 0.2e-3, 2e-3  # an arm farther than this from its held pose was moved [m, rad]
MAX_ZERO_AGE = 0.5  # a wish to zero the wrench that is older is dropped [s]
MAX_STALL_PERIODS = 10  # periods that a target stands after missed ones, for a package from after them

# start_servo.py
JOINT_SPEED, JOINT_ACCELERATION = 0.1, 0.5  # of the fastest joint, at most [rad/s, rad/s^2]
OFF_PATH = 20e-3  # an arm with a joint farther than this from the way has left it [rad]

# driver.py
BRAKING_REACTION_TIME = 0.05  # from a picture that shows a touch to an arm that brakes [s]
