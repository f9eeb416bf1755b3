"""Tuned constants of the fit of materials.

Each entry: quantity, unit, and the measurement behind it, if there is one. Sources:
docs/measurements/identification.md, and the tests in tests/calibration/materials.
"""

# checks.py
MAX_PROBABILITY = 1e-3  # a finding that chance alone would bring more seldom counts
MAX_SIZE_ERROR = 0.05  # of an indenter: moves the stiffness by 3 to 4 %

# estimate.py
PARAMETER_DIFFERENCE = 0.08  # step of a free number for its column of the Jacobian; simulations are exact to some 1e-3
PLACE_STEP = 0.02e-3  # the same of places [m]
MAX_STEP = 0.7  # a step changes no free number by more: a factor of two
MIN_GAIN = 0.2  # of the sum of squares: the noise alone gives it a standard deviation of more than one
MIN_STEP_DEVIATIONS = 0.3  # of their standard deviations, likewise
MAX_IDENTIFIED_HALF_INTERVAL = 0.6
MAX_START_HALF_INTERVAL = 5.0  # a wider interval at the start: the number cannot be identified
COARSE_SIMULATION_ERROR = 0.05  # of a coarse simulation, where no fine one says better: share of the signal
