"""Tuned constants of the calibration of a sensor's light, and limits of its checks.

Each entry: what it is, its unit, and what it was measured on where it was.
Sources: docs/measurements/calibration.md, docs/benchmarks.md, and the tests in tests/calibration/light.
"""

# calibrator.py
MIN_SHADOW_RESIDUAL = 0.02  # share of the change of colour: where slopes leave no more, shadows are not looked for
SHADED_PIXELS = 1000  # the same with cast shadows, which have nine times the terms
# A press is left out if the fitted dent leaves more of its change of colour unexplained than the smaller of
MAX_RESIDUAL_SHARE = 0.5  # share of the change
MAX_RESIDUAL_RATIO = 5.0  # times the median press's share, with three presses or more; at least MAX_GOOD_RESIDUAL
MAX_GOOD_RESIDUAL = 0.05  # share of the change: a press that is explained so well always stays
MIN_SPREAD = 0.2  # share of the picture that presses spread over; else nothing is known of the rest
MAX_NORMAL_ERROR = 8.0  # errors of a press's normals that deserve a warning [degrees]

# darkness.py
MAX_UNIFORM_SHARE = 0.6
DARKNESS_BLUR = 2.0  # through which the darkness of presses is looked at [px]
MIN_DARK_CONTRAST = 0.03  # relative change of colour in the middle of a contact
PRESS_RADIUS = 3.0  # a press changes the gel up to here [contact radii]
MAX_DARKNESS_RESIDUAL = 0.1  # share of darkness that is no function of a dent's depth, at most; 0.003 on real frames

# dent.py
MAX_RIM_RATIO = 0.98  # contact radius over ball radius; the slope is infinite at 1
MAX_RADIUS_RATIO = 6.0  # up to which a dent is followed [ball radii]
MIN_CIRCLE_RADIUS = 4.0  # of a circle that differs from noise [px]
MIN_EXPLAINED_SHARE = 0.7  # share of the difference that a ball's dent must explain
MAX_CONTACT_RATIO = 0.98  # contact radius over the largest that a ball can have, from which a larger ball is tried

# fit.py
FORWARD_BLUR = 0.8  # of the camera, and of what the forward model is fitted to [px]
INVERSE_BLUR = 1.2  # of what the inverse is fitted to [px]
RIM_MARGIN = 5.0  # added to contact and skirt for every radius [px]

# photometry.py
MAX_FEW_PRESSES = 3  # [presses] up to this number they cover too little of the image for light that varies over it
MIN_SIZE_IMPROVEMENT = 0.98  # factor of the left-out error that a larger model must reach
MIN_SHADOW_IMPROVEMENT = 0.93  # the same of a model with cast shadows
MIN_DEPTH_IMPROVEMENT = 0.99  # the same of one that knows the depth, which is known with few terms
MIN_SLOPES_IMPROVEMENT = 0.995  # and of one to which slopes look otherwise at depth
# By so much the terms of slopes at depth are smaller than others: the ridge holds them back ten times as strongly. Of
# all slopes and depths a ball shows few together.
DEEP_SLOPE_SCALE = 0.1**0.5

# press.py
SKIRT_RADIUS = 2.3  # contact and skirt reach this far [contact radii]
UNTOUCHED_RADIUS = 3.0  # beyond, the gel is untouched [contact radii]
MIN_UNTOUCHED_SHARE = 0.15  # of the picture, for a drift that varies over it
MAX_SATURATED_CONTACT = 0.4  # share of a contact that may be saturated; beyond, the press is refused
MIN_SECOND_CONTACT = 0.7  # strength of a second patch, over that of the contact, that makes it a contact too ...
MIN_SECOND_AREA = 0.3  # ... if it also is so large, over the contact's patch: specks of dirt or glare are smaller

# robot.procedures.presses
MIN_SEPARATION = 0.5  # of two presses' centres [larger contact radius]

# refinement.py
RIM_BLUR = 1.0  # of camera and smoothing together, through which the rim of a contact is seen [px]
# Thinness of the gel: the ball's radius over the gel's thickness
FIRST_THINNESS = (0.1, 1.0)  # the refinement starts from a thick gel and from a thin one
THINNESS_BOUNDS = (0.02, 3.0)  # [-] of the search
MAX_ALTERNATIVE_COST = 1.2  # times the least cost, up to which what the other start leads to is a solution too

# press_shapes.py
SCALE_PRIOR = 1.0  # holds the mean logarithm of the balls' radii at 0: the light explains any common factor
MIN_BALL_GAP = 0.1  # between two groups of balls, logarithm of their radii; one ball shows 0.05 under uneven light
MIN_GAP_DEVIATIONS = 4.0  # and in standard deviations within the groups

# consistency.py
MAX_LINK_RATIO = 4.0  # times the median link; a DIGIT, whose lamps stand low, shows 2.4
MIN_FINE_POWER_RATIO = 0.5
CONTACT_BLUR = 3.0  # of a change of colour before a contact is looked for in it [px]
MIN_COMMON_CONTACT = 0.3  # where the presses differ from it; far shadows of a DIGIT's presses show 0.26
MIN_EXPLAINED_REFERENCE = 0.8

# verdict.py
MIN_PRESSES = 3  # [presses] with fewer a calibration is not to be trusted
GOOD_PRESSES = 5
# Means over all presses, each predicted by the others: up to the first good, beyond the second not to be trusted
NORMAL_ERROR_LIMITS = (5.0, 8.0)  # errors of the normals in contact [degrees]
MIN_CORRELATION = (0.97, 0.95)  # of predicted and real change of colour
RESIDUAL_LIMITS = (0.15, 0.35)  # share of the change of colour that no dent explains
MAX_RADIUS_UNCERTAINTY = (0.03, 0.08)  # uncertainty of the contact radii [-]
MAX_SCALE_ERROR = (0.05, 0.12)  # of lengths, by a press of known depth or by the size of the gel [-]
# Ratio of the axes of contacts, less 1 and twice its uncertainty: round ones of real sensors show 0.01 to 0.025
MAX_STRETCH = (0.03, 0.05)
MAX_LEFT_OUT = 1 / 3  # share of the presses
MIN_DIRECTED_SHARE = 0.1  # least share of the power of flanks' change of colour that differs from flank to flank
MAX_ERROR_RATIO = 0.5  # error of one press over the error of predicting nothing: its circle does not fit
MAX_PRESS_CONTACT_RATIO = 0.95  # contact radius over the ball's: no gel is pressed so far
MAX_COMMON_CONTACT_RATIO = 0.9  # the same of all presses together: some are always lighter
MIN_WIDEST_CONTACT_RATIO = 0.35
MAX_DEPTH_RATIO = (0.5, 0.9)  # depth over the thickness of the gel
MAX_IDENTIFIABLE_THICKNESS = 1.5  # thickness of a gel over the ball's radius, up to which slopes identify it
MAX_THICKNESS_RATIO = 2.5  # factor between the gel's thickness found by slopes and the configured one
