"""Tuned constants of contact.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics.md ("Contact"),
docs/measurements/physics.md, and the tests in tests/tacsim/physics/contact.
"""

CONTACT_DAMPING = 0.3  # [k dt] dashpot of a contact, normal and tangential: c = 0.3 k dt = 0.3 m / dt
# [-] of a change of the normal force that its memory takes in a substep. In real time it is 0: the memory follows the
# overlap with a delay, so it creates energy, which only damping takes away.
FORCE_MEMORY_RATE = 0.05
MIN_SURFACE_AREA = 0.1  # [unmoved area] of a surface cell seen from above: below, it counts as folded

# Particles
PARTICLE_TANGENTIAL_STIFFNESS = 0.5  # [normal stiffness] of a particle's contact

# Indenters
INDENTER_TANGENTIAL_STIFFNESS = 0.25  # [normal stiffness] meets the torsion of a bonded punch at 1, 0.5 and 0.25 mm
# [(k h)^2] the surface under the contact points is that of the nodes, each wave of number k smoothed by this share of
# it. An element with one integration point is too soft by 0.124 to 0.135 (k h)^2, and the surface acts twice. With the
# B-spline of the nodes alone (0.125) a ball of 4 mm has +15 % force at 0.1 mm.
SURFACE_SMOOTHING = 0.065
# [stiffness] of a contact point before an indenter or little inside it, and how deep it has all of it [elements]. With
# all of it everywhere contacts are 0.04 elements too narrow, with a third 0.08 too wide; without the depth edges cut in
# (1 to 3 % of force).
RIM_STIFFNESS, RIM_DEPTH = 0.6, 0.05
MIN_PRESSURE = 1e-6  # [shear moduli] a pressure below that is none, and its memory ends
MAX_TOUCH_DISTANCE = 0.5  # [elements] a point farther from the indenter touches nothing
MAX_SUBSTEP_TRAVEL = 1.0  # [elements] nothing moves so far in a substep: cells farther away have no memory
