"""Measurements: `tacsim bench`, and modules that run by themselves (`python -m benchmarks.held_out`)."""

import os

# As the command has it (robot.cli): on a busy machine several threads of BLAS spin, and processor time is theirs.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
