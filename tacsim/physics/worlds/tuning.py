"""Tuned constants of worlds: time step, damping, and limits within which a motion counts as settled.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics-contact.md, docs/physics-motion.md,
docs/measurements/physics.md, docs/decisions/0002-quasi-static-controller.md, and the tests in
tests/tacsim/physics/worlds.
"""

# All worlds
MAX_RETRIES = 2  # of a motion that fails; each halves the time step
SAFE_PATH_SHARE = 0.9  # [-] of the path of a failed motion: an instability is detected some launches after its start
REST_TOLERANCE = 1e-4  # [-] residual of the state at rest in which a motion in real time begins
INITIAL_GAP = 0.1e-3  # [m] between the gels and the body, or the indenter, at construction

# Two gels and a body
BODY_COURANT = 0.5  # [-] dt / (smallest spacing / wave speed): at 0.8 the contact of body and gel fails, without a NaN
# Damping ratios zeta, rate = zeta c / gel thickness, of gel and body (relative to its driven affine motion). Damping of
# a driven motion changes its path, since gels deform and the body spreads; damping of a hold does not.
GEL_ZETA, BODY_ZETA = 0.8, 0.6
GEL_ZETA_HELD, BODY_ZETA_HELD = 1.6, 1.2
YIELDING_ZETA_HELD = 0.3  # of a held body that yields: more damping would delay its creep
GEL_ZETA_DRAGGED, BODY_ZETA_DRAGGED = 1.6, 1.2  # while a body is dragged: without it oscillations change the end state
# In flowing motions: damping of the body raises forces, and oscillations of the gel make clay yield
GEL_ZETA_FLOWING, BODY_ZETA_FLOWING = 1.2, 0.3
# [pressure wave speed] of a gel's shear wave (nu 0.48): below it zeta is reduced in proportion. With full damping, a
# gel of nu 0.499 crept until clay yielded: 28 % low at `learn`, now 0.8 %.
FULL_DAMPING_SHEAR_SPEED = 0.196
# [-] of the contact stiffness that is stable for single particles and gel nodes: collective modes have less inertia.
# With 1 and with 0.9, a cube of 40 layers oscillated between its gels, 3.8 N on one and 2.1 N on the other; with 0.65
# drags of slides are 2 % low.
COLLECTIVE_STIFFNESS = 0.75
# [particle mass / step^2] the largest stiffness of a particle's contact: with more, between gels of 10 MPa, a cube ends
# 16 % low, settled
MAX_PARTICLE_STIFFNESS = 0.5
# [-] smallest share of a path along the gels that is damped as a drag: a path that also closes would end 3 % low
MIN_DRAG_SHARE = 0.9
# [friction limit] decrease by the inertia of a dragged body and of the gel under it at the stop: drags end within 1 to
# 2 % of slow ones; at 0.1 4 % low, without a limit 11 to 18 %
MAX_BRAKING_FORCE = 0.045
MAX_DRAG_OVERSPEED = 1.5  # [-] of the speed by MAX_BRAKING_FORCE: above it, a drag never counts as settled
# [default speed] of a body that yields: at 2 clay ends 2 % low, at 4 9 to 11 %, at 7 26 %; above the limit, no motion
# counts as settled
MAX_YIELDING_OVERSPEED = 3.0
# [particle spacing / gel thickness] relative decrease of force in the hold of a body that yields (3.5 % at draft):
# above it, motions end 3 to 30 % from slow ones, and never count as settled
MAX_FORCE_LOSS = 0.28
MAX_GEL_OVERLAP = 0.25  # [gel thicknesses] there is no contact between gels: a larger overlap is refused
# [yield stresses, Frobenius norm] of hydrostatic tension, which a squeezed body does not have: above it, particles have
# strains that no grid node resolves, and a motion is not settled. The second: smallest growth [-], above rounding.
MAX_TENSION, MIN_TENSION_GROWTH = 3.0, 1.01
MAX_GREEN_STRAIN = 0.3  # [-] norm of F^T F - I since the grid's reference: above it, the grid gets a new reference

# An indenter on a gel
# [-] dt / (element size / wave speed). Edges of a box tear the surface at 0.6, without a NaN; 0.5 costs overlap.
PRESS_COURANT = 0.4
# zeta of the gel; its limit is the second times the speed ratio of shear and pressure wave: damping delays a drag (a
# ball on a gel of nu 0.495, 8 mm thick, had 5 % too little drag)
PRESS_ZETA, PRESS_ZETA_BY_SHEAR = 0.5, 2.55
TURNING_ZETA_SHARE = 0.4  # [-] of zeta for a slide normal to the drag: without it the drag lags by 1 to 3 degrees
# [gel thicknesses] a slide with indentation is as slow as a path of this length: 3 to 11 % of the drag is missing
# without this and MAX_LIMIT_RATE
SHORT_INDENTING_SLIDE = 1.0
# The friction limit follows the pressure within the time of a wave through the gel at this friction [-]; with half of
# that time slides oscillate (6 % low without it). With less friction, and in slides with indentation, it follows
# faster, by up to the second: with one delay slides at mu 0.3 and 0.7 have errors of 0.41 and 0.31 %, with this rule
# 0.30 and 0.15 %.
FLUTTER_FRICTION, MAX_LIMIT_RATE = 1.5, 8.0
MAX_DIP = 0.5  # [spacings of contact points] of an indenter between contact points; the largest such ball is 0.35
MAX_BULGE = 0.1  # [indenter depths] assumed height of the gel around an indenter, for the contact of its edges
MESH_MARGIN = 2.0  # [elements] a point farther from a mesh does not touch it in the next launch
MESH_GRID_SPACING = 0.1e-3  # [m] of a mesh's distance grid
