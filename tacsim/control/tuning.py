"""Tuned constants of control above an arm.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: the tests in tests/tacsim/control.
"""

# contact_signal.py
MIN_CONTACT_HEIGHT = 20e-6  # deeper than this counts as contact: ten times the usual gel texture of 2 um [m]
MIN_CONTACT_DIFFERENCE = 0.10  # relative change of colour that counts as contact; camera noise is 0.02 to 0.03 [-]

# load_controller.py
LOAD_TOLERANCE = 0.01  # of the load: an error within it is left alone, so an arm at its load rests
MAX_TRAVEL = 5e-3  # farthest from where the arm began along z; beyond, the load counts as out of reach [m]
