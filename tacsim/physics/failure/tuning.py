"""Limits of a physical state, and of the dumps of failures. All are validity limits.

Each entry: what it is and its unit. Source: the tests in tests/tacsim/physics/failure and tests/stability.
"""

MIN_STEP_VOLUME = 0.1  # [-] det(I + dt C) of a particle in one substep
MAX_SPEED = 0.5  # [wave speed] of a particle or gel node
MAX_COURANT = 1.0  # [-] time step / time of the pressure wave through the smallest cell or most compressed element
MAX_GRID_NODES = 20_000_000  # of one environment; 80 bytes each on a CPU, in four copies
MAX_DUMPS = 20  # in one folder: many failures in a training must not fill the disk
