"""Tuned constants of the elastoplastic body and its grid.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics.md ("Plasticine"),
docs/measurements/physics.md, and the tests in tests/tacsim/physics/body.
"""

MAX_TIED_NODE_MASS = 0.05  # [particle masses] a node with less is tied to heavier ones (tests: test_followers.py)
MAX_LEADER_DISTANCE = 3  # [cells] every particle has a heavy node within two cells of each that it reaches
MAX_LEADER_SPREAD = 1.0  # [cells] by which a leader may be farther than the nearest one
SLOPE_RIDGE = 1e-8  # [-] on slopes: leaders in a plane determine none across it, which is 0 then
SURFACE_DEPTH = 1.0  # [spacings] particles deeper than that are covered by those of the surface
MIN_SURFACE_DISTANCE = 0.01  # [spacings] from the surface: keeps the inverse finite
GRID_BORDER = 4  # [cells] that a grid reaches beyond its particles' places, at most
STENCIL_REACH = 1.501  # [cells] from a particle: at and beyond, no node gets anything of it, whatever is rounded
# Largest arguments of the power series of log1p, log and exp [-]: errors are below float32's rounding, 1.4e-5 relative,
# 3e-6 absolute (test_material.py)
MAX_LOG1P_ARGUMENT, MAX_LOG_ARGUMENT, MAX_EXP_ARGUMENT = 0.4, 0.5, 0.2
