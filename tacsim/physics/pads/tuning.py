"""Tuned constants of gel pads that follow an engine step by step.

Each entry: what it is, its unit, and the error without it. Sources: docs/mujoco.md,
docs/decisions/0022-gels-in-an-engine.md, and the tests in tests/tacsim/physics/pads.
"""

# [mm] kernel time of a second: how heavy a gel responds. With half of it a ball of 5 g is lost at steps of 1 ms; with
# more, a step takes longer in proportion. The true inertia is some 30 times smaller.
PAD_SECOND = 6.4e3
# Stiffness of a patch within a step: shares of the layer's modulus in uniaxial strain along z, since the gel gives way
# sideways, and of its shear modulus along the surface; and of the depth that the pressure wave reaches. With these, it
# is 0.7 to 1.4 times what small motions of balls, boxes and rods show in steps of 0.5 to 2 ms, nu 0.45 to 0.48.
PATCH_NORMAL_SHARE, PATCH_SHEAR_SHARE, PATCH_DEPTH_SHARE = 0.5, 1.4, 0.7
# [-] share of a change of the wrench within a step that stays in the next one, without motion: 0.4 to 0.97 along the
# normal, -0.1 to 0.6 along the surface. With 1 objects of 5 g are thrown off: their wrench is mostly viscous.
NORMAL_MEMORY, SHEAR_MEMORY = 0.6, 0.3
MIN_LEVER = 1e-3  # [mm] of a patch: contact at a single point carries no twist
SLIDING_SHARE = 0.97  # [limit of friction] from which a contact counts as sliding: friction is below it in most slides
MAX_START_OVERLAP = 0.02  # [gel thicknesses] at the first pose: more would meet the gel in one substep, as a blow
MAX_PAD_TRAVEL = 0.5  # [elements] of a point of an object relative to a pad in a substep
CHECKED_STEPS = 16  # steps between two checks that a gel resolves a tip that touches
RIM_POINTS = 12  # points along each side of a gel at which the housing around it is checked
