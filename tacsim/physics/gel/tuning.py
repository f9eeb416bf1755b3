"""Tuned constants of the gel's elements.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics-gel.md,
docs/measurements/physics.md, and the tests in tests/tacsim/physics/gel.
"""

# [-] stiffness of the hourglass modes over 2 mu: the exact integral of a shear mode of a cube. At 0.03 / 6 surfaces
# are rough by 6 um, at 2 / 6 presses are 5 to 7 % too stiff (docs/physics.md has the table).
HOURGLASS_STIFFNESS = 1.0 / 6.0
MIN_VOLUME_RATIO = 0.05  # [-] J of an element, or of a particle (failure/health.py): below, it counts as inverted
# Below this volume ratio [-] a corner has a pressure, with a bulk modulus of this multiple of lambda + 2 mu. In a gel
# that is dragged with high friction corners reach 0.2 by the material law: at 0.4 a ball at mu = 1.5 lost a quarter of
# its drag.
MIN_CORNER_RATIO, CORNER_STIFFNESS = 0.15, 24.0
# [1 / step^2] the largest squared frequency of a corner, for nodes with the mass of surface nodes. The stiffness of a
# corner between stretched edges grows with the squares of its faces; without the limit such corners were unstable: a
# retry, or a state at rest with a force 14 % low.
MAX_CORNER_FREQUENCY = 1.5
# [-] gradient of an element's hourglass modes below which corners are not computed (they take 7 % of a press's time):
# corners are then above MIN_CORNER_RATIO, unless the element is also much sheared
MIN_SKEW = 0.2
