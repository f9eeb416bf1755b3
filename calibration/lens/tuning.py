"""Tuned constants of the calibration of lenses and views.

Each entry: what it is, its unit, and what it was measured on where it was.
Sources: docs/measurements/calibration.md, and the tests in tests/calibration/lens.
"""

# board.py
MAX_SAME_POINT_DISTANCE = 0.35  # distance of two points at the same place [distance of neighbours]
MAX_OUTER_DOT_SHARE = 0.5  # share of a border with other dots beyond it; above it the board is larger than described
MIN_DOT_CONTRAST = 0.4  # of a dot's pixels, share of its maximum

# view.py
MAX_RESIDUAL = 1.5  # of a lens, root mean square [px]
MAX_FOCAL_DEVIATION = 0.03  # relative standard deviation of the focal length
MAX_PLANE_MISFIT = 0.06  # of a plane: root mean square over the distance of neighbouring points
MIN_REDUCTION = 1.5  # factor of the pixel pitch below which pictures are not resampled
