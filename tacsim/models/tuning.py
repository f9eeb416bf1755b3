"""Tuned constants of scenes: how fast motions are by default, and what a scene may ask for.

Each entry: what it is, its unit, and what it was measured on where it was. Sources: docs/physics-motion.md ("Speed"),
docs/measurements/physics.md, docs/decisions/0002-quasi-static-controller.md, and the tests in tests/tacsim/models.
"""

# scene.py
# Peak Mach number of motions between states of rest at DEFAULT_TOLERANCE, and in proportion to a smaller tolerance:
# what the yield stress allows over the stress that the motion costs, within bounds; where nothing yields, a share of
# the speed of the gel's shear wave (docs/decisions/0002).
MACH_BY_STRESS = 3.7
MIN_MACH = 0.001
MAX_MACH = 0.03
DEFAULT_TOLERANCE = 1e-2
# What the gel's motion adds to that stress: the impedance of its shear wave, and at most the body's own, times these
GEL_STRESS_SHARE = 2.5
MAX_GEL_STRESS_SHARE = 2.0
MACH_BY_SHEAR = 0.1
# so much faster may sensors go whose gels and body answer as if they were lighter: no indenter, no seed
LIGHT_SPEED_GAIN = 1.25
FLOW_MACH = 0.02  # mean Mach number of motions that flow into one another
LIGHT_FLOW_GAIN = 1.5  # times as fast, where gels and body answer as if they were lighter
MIN_EDGE_RADIUS = 0.5  # element sizes: an edge that is less round catches on the mesh
MAX_ELEMENTS = 5_000_000  # elements of one gel, or its particles in the seed's scheme; a standard gel has 12,800
