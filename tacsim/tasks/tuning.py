"""Tuned constants of tasks and scripted policies.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/tasks.md, and the tests in
tests/tacsim/tasks.
"""

# knead.py
MAX_TOUCHES = 60  # [touches] earlier touches show a shape that kneading has changed
MIN_TOUCH_DEPTH = 0.05  # of the greatest depth: less is the gel's own slope, or noise
MAX_PRESSURE_SHARE = 0.9
CLOSING_STEPS = 30.0  # of the teacher: it takes so large a part of the height that is left in each control step
ARRIVAL_SHARE = 0.2  # of max_step: so near to where it goes, the scripted policy turns

BALL_HEIGHT_SHARE = 0.9  # of a ball's diameter, to which the gels close: 0.83 and 1 leave more (8 bodies, 160 steps)
BALL_CIRCLE_SHARE = 0.8  # of a ball's diameter: radius of the circle on which it is rolled

# lengthen.py
LENGTH_RULE = (0.51e-3, 0.440, 0.596)  # [m, -, -] of 48 training draws, up to 14 mm long; deviation 0.81 mm
MIN_PRESSED_DEPTH = 0.04e-3  # of a contact whose length pictures show; at 0.02 mm noise moves it by millimetres [m]
MIN_LENGTH_SHARE = (
    0.2  # assumed growth of the body over the displacement of the sensors, at least; measured: 0.3 to 1.1
)

# relief.py
MIN_RELIEF_FORCE = 0.05  # of the upper gel: a light touch [N]
RELIEF_CLEARANCE = 0.8e-3  # above the body while the sensor moves sideways [m]
TOUCH_STEP = 0.05e-3  # of the sensor close to the surface [m]
RELIEF_TOLERANCE = 0.07e-3  # a dent that lacks less is deep enough [m]
FIRST_EXCESS = 0.25e-3  # by which the first press of a dent goes deeper than its goal [m]
ONLY_EXCESS = 0.6e-3  # the same where no other follows: 5 of 16 draws like the benchmark's; 0.9e-3, 1.2e-3: 2 [m]
MAX_PRESSES = 6  # of a dent at one visit

# reposition.py
MIN_FORCE = 0.01  # a smaller normal force counts as no contact [N]
ARRIVAL_DISTANCE = 0.02e-3  # the scripted policy holds when its estimate is this close to the goal [m]

# squeeze.py
MIN_BODY_SHARE = 0.1  # assumed compression of a body over the displacement of the sensors, at least
ARRIVAL_HEIGHT_ERROR = 0.01e-3  # the scripted policy holds when its estimate is this close to the goal [m]
FIRM_GRIP_SIGNAL = 0.05  # contact signal of a firm grip: five times what camera noise of 2 % gives [-]
CLOSING_STEP = 0.1e-3  # motion of each sensor in a control period [m]
MAX_GRIP_FORCE = 5.0  # of a gripper that closes: it holds 0.5 kg, and presses a gel of 4 mm by some tenths of a mm [N]

# hold.py
FORCE_DECREASE = 0.92  # force of a step over that of the step before, while nothing slips
SLIP_FLOW_CHANGE = 0.02  # relative change of the mean flow of a sensor in a step that shows a slip
MIN_FLOW = 2e-6  # a smaller mean flow says nothing [m]
MIN_WEIGHT = 0.01  # a smaller load on the hand is taken for this [N]
# Of 32 boxes of unknown size, mass, friction and gel that the benchmark's `hold` may be fitted to, below 6 times the
# least force: the logarithm of the rule deviates by 0.21
GRIP_RULE = (2.51, 0.88, 0.61)

# turn.py
MAX_TURN_STEP = 0.05  # turn of the object in a control step that the scripted policy aims at [rad]
LOOSENING = 0.95  # force of a step over that of the step before, while it turns too slowly
TIGHTENING = 1.12  # the same while it turns too fast
STOPPING_STEPS = 0.5  # it turns on by so many steps after the grip is tightened

# peg.py, on the scene `peg`
MAX_LATERAL_ERROR = 0.15e-3  # the expert goes down where the bar's end is this close to the hole's axis [m]
PEG_LIFT = 0.5e-3  # and lifts it so far above the block before it goes sideways [m]
MAX_PEG_SHIFT = 0.2e-3  # sideways in a control step while it goes down [m]

# peg_policy.py, on the scene `peg`
MIN_PRESS = 0.5  # less force along the fingers is no contact [N]
SEARCH_PRESS = (
    5.0  # force along the fingers at a place that it tries: lays a bar flat on a block turned by 3 degrees [N]
)
INSERTION_PRESS = 8.0  # force along the fingers while it pushes the bar down, at most [N]
GRIP_STIFFNESS = 5000.0  # of the gels along the fingers, by which the bar gives way [N/m]
COMPLIANCE = (0.05e-3, 0.2e-3)  # displacement of the hand along a lateral force, world x and y [m/N]
MAX_CORRECTION = 0.3e-3  # largest of these displacements in a control step [m]
RELAXATION = 1e-3  # displacement of the hand along a lateral force, world y, so that the bar can lie flat [m/N]
SEARCH_STEP = 0.4e-3  # between two places: less than the play of the bar in the hole [m]
SEARCH_RANGE = 2.4e-3  # from the start, to either side along world x [m]
TIPPED_RANGE = 3.2e-3  # the same along world y, where the bar's end stays behind the hand [m]
TIPPED_SHARE = 0.7  # of half the bar's width: support further out shows that it tips
MIN_HOLE_DEPTH = 0.8e-3  # of the bar's end below the surface: it is in the hole [m]
STUCK_STEPS = 8  # in which it goes less than MIN_PROGRESS deeper: it is stuck
MIN_PROGRESS = 0.1e-3  # [m]

# drawer.py, on the scene `drawer`
USUAL_PERIOD = 50e-3  # control period in which a task's max_step is the greatest speed [s]
GRIP_DECREASE = 0.9  # force of a step over that of the step before, while nothing slips
ARRIVAL_LEFT = 0.1e-3  # the scripted policy stops where so little of the travel is left [m]
SLIP_SHARE = 0.25  # of max_step: a handle that lags by more than this in a step slips
SECOND_INCREASE = 1.15  # force of a step over that of the step before, where the handle slips again
