"""Measurements: `tacsim bench`, and modules that run by themselves (`python -m benchmarks.held_out`)."""

import os

# As in the command (robot.cli): on a busy machine several BLAS threads spin, and use processor time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
