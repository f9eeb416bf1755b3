"""Tuned constants of contact.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics-contact.md,
docs/measurements/physics.md, and the tests in tests/tacsim/physics/contact.
"""

CONTACT_DAMPING = 0.3  # [k dt] dashpot of a contact, normal and tangential: c = 0.3 k dt = 0.3 m / dt
# [-] share of a change of the normal force that its memory takes over in a substep. In real time it is 0: the memory
# follows the overlap with a delay, so it creates energy, which only damping removes.
FORCE_MEMORY_RATE = 0.05
MIN_SURFACE_AREA = 0.1  # [undeformed area] of a surface cell, projected along z: a smaller one counts as folded

# Particles
PARTICLE_TANGENTIAL_STIFFNESS = 0.5  # [normal stiffness] of a particle's contact

# Indenters
INDENTER_TANGENTIAL_STIFFNESS = 0.25  # [normal stiffness] meets the torsion of a bonded punch at 1, 0.5 and 0.25 mm
# [(k h)^2] amplitude loss of a wave of wave number k on the surface under the contact points, compared with the nodes.
# An element with one integration point is too soft by 0.124 to 0.135 (k h)^2, and the surface acts twice. With the
# B-spline of the nodes (0.125) the force of a ball of 4 mm is 15 % too high at 0.1 mm.
SURFACE_SMOOTHING = 0.065
# [full stiffness] of a contact point outside of an indenter, and the overlap at which the stiffness is full [elements].
# With full stiffness everywhere contacts are 0.04 elements too narrow, with a third 0.08 too wide; without RIM_DEPTH
# the force at edges is wrong by 1 to 3 %.
RIM_STIFFNESS, RIM_DEPTH = 0.6, 0.05
MIN_PRESSURE = 1e-6  # [shear moduli] a smaller pressure is set to 0
MAX_TOUCH_DISTANCE = 0.5  # [elements] a point farther from the indenter does not touch it
MAX_SUBSTEP_TRAVEL = 1.0  # [elements] no point moves so far in a substep: cells farther away have no memory
