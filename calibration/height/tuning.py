"""Tuned constants of the conversion of a picture to a height.

Each entry: what it is, its unit, and what it was measured on where it was.
Sources: docs/measurements/calibration.md, docs/benchmarks.md, and the tests in tests/calibration/height.
"""

# slopes.py
COLOUR_NOISE = 0.02  # standard deviation of the relative change of colour: a camera's noise [-]
SLOPE_PRIOR = 0.5  # standard deviation of slopes: where colours do not decide, the smaller slope is likelier [-]
MAX_COLOUR_DISTANCE = 0.2  # between a colour and the nearest that the light can make; beyond, no slope has it [-]
MAX_TABLE_SLOPE = 1.5  # along each axis [-]
MAX_EXTRAPOLATION = 1.1  # slopes reach up to this times the steepest calibrated one

# surface_finder.py
MAX_INK_LEVEL = 0.6  # a printed dot is darker in all channels, relative to the mean of the gel [-]
RIM_WIDTH = 0.5e-3  # width of the band along the border of the view that counts as untouched [m]
PRIOR_WEIGHT = 0.4  # (error of colour that is usual / error of slope that is usual)^2
MAX_CERTAIN_ERROR = 0.2  # error of colour above which a channel has little weight [-]
MIN_CONTACT_CHANGE = 0.1
