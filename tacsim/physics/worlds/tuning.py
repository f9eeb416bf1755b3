"""Tuned constants of worlds: time step, damping, and what a motion must not exceed to count as settled.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics.md ("Contact", "Controller"),
docs/measurements/physics.md, docs/decisions/0002-quasi-static-controller.md, and the tests in
tests/tacsim/physics/worlds.
"""

# All worlds
MAX_RETRIES = 2  # of a launch that fails; each halves the time step
SAFE_PATH_SHARE = 0.9  # [-] of how far a motion came that failed: an instability shows some launches after its start
REST_TOLERANCE = 1e-4  # [-] residual of the state of rest in which a motion in real time begins
INITIAL_GAP = 0.1e-3  # [m] between the gels and the body, or the indenter, at construction

# Two gels and a body
BODY_COURANT = 0.5  # [-] dt / (smallest spacing / wave speed): at 0.8 the contact of body and gel fails, without a NaN
# Damping ratios zeta, rate = zeta c / gel thickness, of gel and body (against its driven affine motion). While a motion
# is driven damping falsifies its path, since gels yield and the body spreads; while it is held, it does not.
GEL_ZETA, BODY_ZETA = 0.8, 0.6
GEL_ZETA_HELD, BODY_ZETA_HELD = 1.6, 1.2
YIELDING_ZETA_HELD = 0.3  # of a held body that yields: what creeps has only this drag to overcome
GEL_ZETA_DRAGGED, BODY_ZETA_DRAGGED = 1.6, 1.2  # while a body is dragged: without it the body swings and keeps that
GEL_ZETA_FLOWING, BODY_ZETA_FLOWING = 1.2, 0.3  # while motions flow: body drag raises forces, gel ringing yields clay
# [pressure wave speed] of a gel's shear wave (nu 0.48): below it zeta falls in proportion. Fully damped, a gel of nu
# 0.499 crept until clay yielded: 28 % low at `learn`, now 0.8 %.
FULL_DAMPING_SHEAR_SPEED = 0.196
# [-] of the contact's stiffness that particles and gel nodes bear one by one: all of them together are lighter. With
# all of it, and with 0.9, a cube of 40 layers swung between its gels without end, 3.8 N on one and 2.1 on the other;
# with 0.65 slides are dragged 2 % less.
COLLECTIVE_STIFFNESS = 0.75
# [particle mass / step^2] the largest stiffness of a particle's contact: beyond, between gels of 10 MPa, a cube ends
# 16 % low, settled
MAX_PARTICLE_STIFFNESS = 0.5
# [-] least share of a path along the gels that is damped as a drag: one that also closes ends 3 % low if it is
MIN_DRAG_SHARE = 0.9
# [friction limit] that the inertia of a dragged body and of the gel under it takes away where it stops: drags end
# within 1 to 2 % of slow ones; at 0.1 4 % low, without a limit 11 to 18 %
MAX_BRAKING_FORCE = 0.045
MAX_DRAG_OVERSPEED = 1.5  # [-] times as fast as MAX_BRAKING_FORCE asks for: beyond, a drag never counts as settled
# [fastest default speed] of a body that yields: at 2 clay ends 2 % low, at 4 9 to 11 %, at 7 26 %; beyond, no motion
# counts as settled
MAX_YIELDING_OVERSPEED = 3.0
# [particle spacing / gel thickness] share of its force that a hold may take from a body that yields (3.5 % at draft):
# beyond, motions end 3 to 30 % from slow ones, and never count as settled
MAX_FORCE_LOSS = 0.28
MAX_GEL_OVERLAP = 0.25  # [gel thicknesses] gels do not feel each other: deeper in one another they are refused
# [yield stresses, Frobenius norm] of hydrostatic tension, which nothing gives a squeezed body: beyond, particles have
# strains that no node of the grid feels, and a motion is not settled; if it grew by the second: rounding changes it
MAX_TENSION, MIN_TENSION_GROWTH = 3.0, 1.01
MAX_GREEN_STRAIN = 0.3  # [-] norm of F^T F - I since the grid's reference: beyond, the grid is laid out again
ROTATION_BOOST = 1.0 / 3.0  # [-] of the rigid motions' boost for rotations: with more bodies overshoot after a slide

# An indenter on a gel
# [-] dt / (element size / wave speed). Edges of a box tear the surface at 0.6, without a NaN; 0.5 costs overlap.
PRESS_COURANT = 0.4
# zeta of the gel, and at most the second times its shear wave's speed over that of its pressure wave: damping makes a
# drag lag (a ball on a gel of nu 0.495, 8 mm thick, was dragged 5 % too little)
PRESS_ZETA, PRESS_ZETA_BY_SHEAR = 0.5, 2.55
TURNING_ZETA_SHARE = 0.4  # [-] of zeta for a slide across all of the drag: without it the drag lags by 1 to 3 degrees
# [gel thicknesses] what is pressed in while it slides goes as slowly as a path of this length: 3 to 11 % of the drag is
# missing without this and MAX_LIMIT_RATE
SHORT_INDENTING_SLIDE = 1.0
# The limit of friction follows the pressure within the time of a wave through the gel at this friction [-]; in half of
# it slides flutter (6 % low without it). Of less friction it follows faster, as of what is pressed in while it slides,
# by up to the second: with one delay slides at mu 0.3 and 0.7 end 0.41 and 0.31 % off, with this rule 0.30 and 0.15 %.
FLUTTER_FRICTION, MAX_LIMIT_RATE = 1.5, 8.0
MAX_DIP = 0.5  # [spacings of contact points] of an indenter between them; the largest such ball is 0.35
MAX_BULGE = 0.1  # [indenter depths] by which the gel rises round it, to tell whether edges reach the gel
MESH_MARGIN = 2.0  # [elements] farther from a mesh, nothing touches it in the next launch
MESH_GRID_SPACING = 0.1e-3  # [m] of a mesh's distance grid
