"""Tuned constants of the seed paper's scheme.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics-execution.md, and
the tests in tests/tacsim/physics/seed.
"""

PARTICLES_PER_CELL_EDGE = 2  # [-] grid spacing / particle spacing: 8 particles a cell
COURANT = 0.5  # [-] dt / (grid spacing / wave speed); unstable from 1.0
CONTACT_REACH = 1.5  # [cells] gap at which contact through the grid begins
# Damping ratios zeta, rate = zeta c / thickness (test_world.py): of the gels; of the body against its driven motion
# along z, near critical for the bounce between the gels, and across z, where the gels are softer
GEL_ZETA, BODY_ZETA, BODY_ZETA_ACROSS = 1.0, 0.8, 0.12
READING_INTERVAL = 20  # [substeps] of the hold between two readings of the forces
MIN_SUBSTEPS = 60  # of a motion: a start in fewer substeps is an impact, which adds wrong plastic strain
GRID_OVERHANG = 1.0  # [gel widths] of the grid beyond the gels' rim; a particle farther out is left out
MIN_CELL_HEIGHT = 0.72  # [lateral spacing] of the grid, down to which the number of layers is kept
GRID_MARGIN = 3  # [cells] of grid around the particles
MAX_TILT = 1e-3  # [rad] a smaller tilt is neglected, a larger one is refused
