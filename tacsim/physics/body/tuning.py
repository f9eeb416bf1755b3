"""Tuned constants of the elastoplastic body and its grid.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics-body.md,
docs/measurements/physics.md, and the tests in tests/tacsim/physics/body.
"""

MAX_TIED_NODE_MASS = 0.05  # [particle masses] a node with less is tied to full nodes (tests: test_tied_nodes.py)
MAX_SUPPORT_DISTANCE = 3  # [cells] a full node lies within two cells of each node in a particle's stencil
MAX_SUPPORT_SPREAD = 1.0  # [cells] distance of a full node minus that of the nearest one
SLOPE_RIDGE = 1e-8  # [-] of slopes: full nodes in one plane do not determine the slope normal to it; it is 0 then
SURFACE_DEPTH = 1.0  # [spacings] particles deeper than this never touch the gel
MIN_SURFACE_DISTANCE = 0.01  # [spacings] from the surface: keeps the inverse finite
GRID_BORDER = 4  # [cells] by which a grid extends beyond its particles' positions, at most
STENCIL_REACH = 1.501  # [cells] from a particle: nodes at this distance have weight 0, with any rounding
# Largest arguments of the power series of log1p, log and exp [-]: errors are below float32's rounding, 1.4e-5 relative,
# 3e-6 absolute (test_material.py)
MAX_LOG1P_ARGUMENT, MAX_LOG_ARGUMENT, MAX_EXP_ARGUMENT = 0.4, 0.5, 0.2
ROTATION_BOOST = 1.0 / 3.0  # [-] of the rigid motions' boost, for rotations: with more, bodies overshoot after a slide
