"""Tuned constants of finding and following printed dots.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/decisions/0013-marker-
tracker.md, and the tests in tests/calibration/markers.
"""

# dots.py
# A dot is darker than its surroundings by at least this share of their light; the higher levels part it from others
DARKNESS_LEVELS = (0.2, 0.35, 0.5)
MAX_STEP_ERROR = 0.3  # of a neighbour from one step along the lattice [pitches]
MIN_ROW_SHARE = 0.5  # dots of a row or column of the lattice [number of dots of the fullest one]
MAX_PITCH_ERROR = 0.25  # of the distance of regular neighbours [pitches]

# flow.py
MAX_MISSING = 0.3  # share of the dots in view that a reference may lack
MAX_EXTRA_SHARE = 0.1  # dots beyond the lattice's rows and columns [number of its dots]
MIN_PRESENT_SHARE = 0.75  # share of its dots that an unknown lattice must show
MIN_VISIBLE_SHARE = 0.25  # share of the dots that must be seen for a flow

# tracker.py
NEIGHBOUR_RADIUS = 1.6  # dots this near at rest are neighbours: the diagonal of a square is one [pitches]
# A dot is matched with a point this near to its place [pitches]
MATCH_RADIUS = 0.45  # where the place is predicted
STRICT_MATCH_RADIUS = 0.25  # if other matches will depend on it
# Change of displacement across an edge, at most [pitches]
MAX_STRETCH = 0.4  # within a part that other dots are matched from
MAX_STRETCH_TRACKED = 0.75  # where each dot was followed from frame to frame
EXTRAPOLATION_RADIUS = 0.45  # a dot is at most this far from its extrapolated place [pitches]
# Jumps of the whole lattice
MIN_JUMP_SHARE = 0.04  # of dots and of points that are unmatched: more make a jump likely
MAX_JUMP = 2.6  # [pitches]
# A speck of dirt taken for a dot
MIN_DIRT_MISFIT = 0.1  # distance from the extrapolated place that is suspicious [pitches]
MIN_DIRT_MISFIT_RATIO = 4.0  # ... if it also exceeds the median by this factor
MAX_DIRT_GAIN = 0.25  # another point is the dot if its distance is less than this share
# A dot that moves alone: two dots in one, or glare on it
OUTLIER_MISFIT = 0.15  # distance from the extrapolated place [pitches]
OUTLIER_MISFIT_RATIO = 2.5  # ... if it also exceeds that of each of its neighbours by this factor
