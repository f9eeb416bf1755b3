"""Tuned constants of rigid objects between gel pads.

Each entry: what it is, its unit, and the error without it. Sources: docs/held-objects.md, and the tests in
tests/tacsim/physics/grip.
"""

# [-] mass of object, and of closing pads, over that of the layer of gel, half an element thick, under their contact. At
# 0.2 grips are unstable; at 2.5 the forces at the end of a step lag twice as much.
LAYER_SHARE = 0.75
CLOSING_ZETA = 1.0  # damping ratio of pads that a force closes, against the gels' stiffness
SUPPORT_ZETA = 1.0  # damping ratio of an object on the springs of its support
# Of a guide, as springs [N/m, N m/rad]: 3 N of friction hold it within 0.03 mm; with 1e4 N/m within 0.3 mm
GUIDE_STIFFNESS = (1e5, 1e5, 1e5, 100.0, 100.0, 100.0)
# Time of a step, in times of the gel's pressure wave through its thickness: with less, shear lags behind the pads
STEP_TIME = 3.5
MOVING_SHARE = 0.75  # [-] of the substeps of a step in which the pads move; in the rest all relaxes
MAX_SUBSTEPS = 4000  # of a step: a validity limit
# [-] speed of a pad relative to the others in a step, and the path [gel thicknesses] below which it is slower, so
# that it is not stopped harder: without the second, a slide of 0.25 mm loses 4 % of its drag when it stops
PAD_MACH, SHORT_MOTION = 0.02, 0.5
# [-] speed of an object relative to its pads, and of pads that a force closes: a guard for objects that fall
MAX_OBJECT_SPEED, MAX_CLOSING_SPEED = 0.15, 0.03
MIN_POINTS = 9.0  # contact points whose mass an object has at least: of a first touch
QUIET_TIME = 1.5  # [times of that wave] of balanced forces at the end of a step that settles
SETTLED_TOLERANCE = 2e-4  # [-] imbalance of forces at rest: at 2e-3 the weight of an object is wrong by up to 0.6 %
# [E thickness^2] least reference force of imbalances: positions in float32 are rounded, by 1e-4 N on a soft gel
REFERENCE_FORCE = 0.5
MAX_HOLD = 2000  # [substeps] of a step that settles
# [elements] up to which the distances of a mesh are known beyond a gel's surface; how far pads close on it in a step
MESH_MARGIN, MESH_TRAVEL = 1.5, 0.75
MAX_MASS = 1e3  # [kg] of an object: a validity limit
GRASP_SPRINGS = (50.0, 0.01)  # [N/m, N m/rad] springs that keep an object in place while it is grasped
MAX_GRASP_STEPS = 50  # that settle, until pads have closed: on a mesh, each closes them by MESH_TRAVEL at most
CLEAR_MARGIN = 0.25  # [gel thicknesses] beyond which a pad is clear of an object for certain
EARTH = (0.0, 0.0, -9.81)  # [m/s^2] gravity, world axes, where no other is given
