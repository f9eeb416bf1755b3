"""Tuned constants of the gel's elements.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics.md ("Gel"),
docs/measurements/physics.md, and the tests in tests/tacsim/physics/gel.
"""

# [-] stiffness of the hourglass modes over 2 mu: the exact integral of a shear mode of a cube. At 0.03 / 6 surfaces
# are rough by 6 um, at 2 / 6 presses are 5 to 7 % too stiff (docs/physics.md has the table).
HOURGLASS_STIFFNESS = 1.0 / 6.0
MIN_VOLUME_RATIO = 0.05  # [-] J of an element, or of a particle (failure/health.py): below, it counts as inverted
# A corner presses back below this volume ratio [-], with a bulk modulus of so many lambda + 2 mu. A gel that is dragged
# by much friction has corners of 0.2 by its own law: at 0.4 a ball at mu = 1.5 lost a quarter of its drag.
MIN_CORNER_RATIO, CORNER_STIFFNESS = 0.15, 24.0
# [1 / step^2] the largest squared frequency of a corner, of nodes as light as the surface's. A corner between stretched
# edges is stiffer by the squares of its faces, and shook itself apart: a retry, or a rest 14 % low.
MAX_CORNER_FREQUENCY = 1.5
# [-] gradient of an element's hourglass modes below which no corner is looked at (7 % of a press's time): corners are
# above MIN_CORNER_RATIO then, in an element that is not much sheared besides
MIN_SKEW = 0.2
