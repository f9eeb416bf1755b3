"""Tuned constants of the normaliser, the reference image and drift.

Each entry: what it is, its unit, and what it was measured on where it was.
Sources: docs/measurements/calibration.md, and the tests in tests/calibration.
"""

# frame_normaliser.py
MAX_DOT_LEVEL = 0.7  # of the mean: printed dots are darker

# frame_set.py
MIN_CONTACT_SHARE = 0.001  # of a picture, in which two without contact differ as by a contact
MAX_REFERENCE_CHANGE = 4.0  # median change of the gel outside contact that makes a reference stale [grey levels]

# reference.py
SATURATED_LEVEL = 250.0  # a channel at or above this has lost its signal [grey levels]
MAX_SATURATED_SHARE = 0.05  # of the gel; ten real sensors show 0 to 0.001
MIN_MEAN_LEVEL = 8.0  # of each channel over the gel; below, noise and rounding prevail [grey levels]
# A reference is stale beyond, ...
STALE_SLOPE = 2.0  # slope of the untouched gel; real sensors: 0.3 to 0.7 [degrees]
STALE_COLOUR = 0.05  # change of the untouched gel's colour: the gain of a lamp scales slopes, even without tilt [-]
# ... and the light has changed beyond:
MAX_SLOPE_CHANGE = 20.0  # [degrees]
MAX_COLOUR_CHANGE = 0.5  # [-]
# Red and blue are exchanged
MAX_EXCHANGED_RATIO = 0.5  # if the swap reduces the difference from the known picture by this factor
MAX_SAME_CHANGE = 0.02  # unless the difference is this small without it, each colour relative to its mean [-]
MIN_SWAPPED_CHANGE = (
    0.01  # of each colour relative to its mean, in addition to another gain; a smaller one does not show a swap [-]
)
MAX_UNTOUCHED_CHANGE = 0.08  # change of an untouched pixel without drift [-]
MIN_UNTOUCHED_SHARE = 0.15  # of the view, to measure a drift
# A contact in a picture that must show none is a patch that differs from a known picture ...
MIN_CONTACT_CHANGE = 0.06  # by this amount, without drift and noise [-]
CONTACT_BLUR = 1.5  # of a change of colour before the search for a contact [px]
MIN_CONTACT_AREA = 0.6e-6  # and that has this area, the contact of a ball of 8 mm at 0.05 mm depth [m^2]
