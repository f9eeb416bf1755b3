"""Tuned constants of the comparison of two sources of frames.

Each entry: what it is, its unit, and what it was measured on where it was.
Sources: docs/measurements/comparison.md, and the tests in tests/calibration/compare.
"""

# report.py
MIN_CLOSE_CORRELATION = 0.95  # of the change of colour in contact, from which two sources look alike ...
MAX_CLOSE_ERROR = 0.25  # ... if their error there also is no larger share of what a picture without contact would score

# metrics.py
CONTACT_BLUR = 2.0  # of a change of colour before the search for a contact [px]
# A smoothed change shows contact beyond the largest of
MIN_CHANGE = 5.0  # [grey levels]
MIN_CHANGE_TO_NOISE = 6.0  # times the noise of the picture
MIN_CHANGE_SHARE = 0.25  # of the strongest change
MIN_PATCH_AREA = 30  # a smaller patch is dirt [px]
MAX_ASPECT_ERROR = 0.02  # relative difference of the aspect ratios of two pictures that are scaled to each other
MAX_SHIFT = 0.25  # share of the picture; a larger shift means a wrong pairing, not a wrong mount
MAX_SHIFT_SCATTER = 0.05  # of the pairs' shifts, share of the picture

# scorer.py
MIN_SWAPPED_GAIN = 0.2  # of the correlation, by red and blue exchanged, that makes them look swapped
