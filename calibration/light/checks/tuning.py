"""Tuned limits of the checks of a light calibration.

Each entry: what it is, its unit, and what it was measured on where it was.
Sources: docs/measurements/calibration.md, and the tests in tests/calibration/light/checks.
"""

# consistency.py
MAX_LINK_RATIO = 4.0  # times the median link; a DIGIT, whose lamps stand low, shows 2.4
MIN_FINE_POWER_RATIO = 0.5
CONTACT_BLUR = 3.0  # of a change of colour before a contact is looked for in it [px]
MIN_COMMON_CONTACT = 0.3  # where the presses differ from it; far shadows of a DIGIT's presses show 0.26
MIN_EXPLAINED_SHARE = 0.8

# verdict.py
MIN_PRESSES = 3  # [presses] with fewer a calibration is not to be trusted
GOOD_PRESSES = 5
# Means over all presses, each predicted by the others: up to the first good, beyond the second not to be trusted
MAX_NORMAL_ERROR = (5.0, 8.0)  # errors of the normals in contact [degrees]
MIN_CORRELATION = (0.97, 0.95)  # of predicted and real change of colour
MAX_RESIDUAL_SHARE = (0.15, 0.35)  # share of the change of colour that no dent explains
MAX_RADIUS_UNCERTAINTY = (0.03, 0.08)  # uncertainty of the contact radii [-]
MAX_SCALE_ERROR = (0.05, 0.12)  # of lengths, by a press of known depth or by the size of the gel [-]
# Ratio of the axes of contacts, less 1 and twice its uncertainty: round ones of real sensors show 0.01 to 0.025
MAX_STRETCH = (0.03, 0.05)
MAX_LEFT_OUT = 1 / 3  # share of the presses
MIN_DIRECTED_SHARE = 0.1  # least share of the power of flanks' change of colour that differs from flank to flank
MAX_ERROR_RATIO = 0.5  # error of one press over the error of predicting nothing: its circle does not fit
MAX_CONTACT_RATIO = 0.95  # contact radius over the ball's: no gel is pressed so far
MAX_COMMON_CONTACT_RATIO = 0.9  # the same of all presses together: some are always lighter
MIN_WIDEST_CONTACT_RATIO = 0.35
MAX_DEPTH_RATIO = (0.5, 0.9)  # depth over the thickness of the gel
MAX_IDENTIFIABLE_THICKNESS = 1.5  # thickness of a gel over the ball's radius, up to which slopes identify it
MAX_THICKNESS_RATIO = 2.5  # factor between the gel's thickness found by slopes and the configured one
