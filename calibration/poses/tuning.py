"""Tuned constants of the fits of poses and latencies.

Each entry: what it is, its unit, and what it was measured on where it was.
Sources: docs/measurements/calibration.md, and the tests in tests/calibration/poses.
"""

# ball_touch.py
MIN_TOUCHES = 6  # touches: 18 equations for 9 numbers
MIN_CONTACT_SPREAD = 0.5e-3  # of the contacts over the gel, in the direction in which they vary least [m]
MAX_CAP_MISFIT = 0.15  # root mean square of a cap's residuals, over its depth

# hand_eye.py
MIN_POSES = 6  # poses: 36 equations for 12 numbers

# latency.py
MIN_CORRELATION = 0.7  # below it the two signals are not from one motion
MAX_SECOND_PEAK = 0.85  # height of a second peak over the best one; above it the latency is ambiguous
MIN_SAMPLES = 30  # pictures whose whole search range is inside the arm's record
PEAK_HALF_WIDTH = 40e-3  # range of the fine search; peaks outside are other ones [s]

# robust_fit.py
OUTLIER_DISTANCE = 5.0  # of an outlier: norm of its residuals [standard deviations]
MAX_OUTLIERS = 0.25  # share of the measurements
MAX_SCATTER = 3.0  # over the stated noise; above it there is an error other than noise
