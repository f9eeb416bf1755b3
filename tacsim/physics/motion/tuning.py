"""Tuned constants of motions: controller, paths, slides and motions at constant load.

Each entry: what it is, its unit, and the error without it. Sources: docs/physics-motion.md,
docs/measurements/physics.md, docs/decisions/0002-quasi-static-controller.md, and the tests in
tests/tacsim/physics/motion.
"""

# Controller: launches and holds
SUBSTEPS_PER_LAUNCH = 80  # [substeps] of a driven launch: a control step is one launch or two
# [substeps] of the first launch of a hold, which has the four readings that `remaining_body_creep` needs at `learn`,
# and of later ones. The body's grid is fitted again between launches: with 48 a cube squeezed to a fifth did not
# settle.
SUBSTEPS_PER_HOLD = (16, 12)
COMPARED_READINGS = 2  # [readings] compared with the last one: a single one may have the same phase of an oscillation
FORECAST_READINGS = 20.0  # [readings] over which creep is extrapolated: without it a squeeze ends 9 % high, settled
MIN_FORCE_SHARE = 1e-3  # [E thickness^2] smallest reference force of residuals and load tolerances

# Motions of a given duration
MAX_DRIVE_MACH = 0.3  # [gel wave speed] peak speed of a driven frame: a validity limit, faster motions are refused

# Paths. Times in [times of the gel's pressure wave through its thickness], lengths in [gel thicknesses].
MIN_RAMP_TIME, MIN_FLOW_TIME = 2.0, 1.25  # of a ramp; of a flowing step
FLOW_RISE_TIME = 0.25  # after which a flowing step has the direction of its path
READING_INTERVAL = 1.0  # time between two readings of the forces in a hold
# [mean velocity] at which a flowing step passes its target. With a higher value it overshoots where the next step turns
# back, and a body that yields keeps the overshoot; with a lower value the gel is decelerated.
BLEND_VELOCITY = 0.5
# Paths shorter than these are slower, so that none has a higher deceleration than a long one: of a body that yields; of
# a contact with friction, along the surface. Otherwise the stop adds plastic strain or drag (decision 2).
SHORT_PATH, SHORT_SLIDE = 0.5, 0.25
ROUNDING = 1e-6  # [-] relative rounding error of a number of substeps or a length that is neglected
MAX_SUBSTEPS = 1_000_000  # of one motion: a validity limit, hours of computation

# Slides of an indenter with friction
MAX_SLIDE_SHEAR_MACH = 0.155  # [gel shear wave speed] slides end within 2 % of slow ones; at 0.25 3 %, at 0.5 17 % off
MAX_BLOCKED_SLIDE = 0.5  # [element sizes] of an edge that catches on the mesh; beyond, drag is wrong by 50 %
# [gel thicknesses] of a slide: beyond, the gel slips in snaps, and drag is wrong by up to 19 %. The second, where
# friction is above STEEP_FRICTION and the indenter deeper than DEEP_WITH_EDGES: 8 of 280 such slides had errors of up
# to 5.6 %.
MAX_SLIDE_LENGTH, MAX_DEEP_SLIDE_LENGTH = 0.5, 0.4
STEEP_FRICTION = 1.0  # [-] above it, slides longer than that snap at any depth
DEEP_WITH_EDGES, DEEP_WITHOUT_EDGES = 0.15, 0.25  # [gel thicknesses] below the surface: deeper slides snap
# [default speed] of a slide whose direction is normal to the present drag: the share is the friction, within this
# range. Without it the drag of slides that turn has an rms error of 1.6 to 1.9 % (now 0.6 to 0.7 %), up to 10 % in
# single states.
TURNING_SPEED_RANGE = (0.35, 0.5)
# [default speed] of a lift with full drag. Without it drag fell to 0.74 of the friction in three lifts of 0.1 mm.
LIFTING_SPEED = 0.35
# The end of a slide with edges is slower where its friction is above this value times the root of (element size / gel
# thickness): contact slips in many small snaps. Up to 5.5 % of the drag is lost without it, 1.8 % with it.
WALL_SNAP_FRICTION = 1.9
SLOWED_WALL_LENGTH = 0.5  # [element sizes] of the slow end of the slide; a slow slide as a whole is not more accurate
MAX_SNAP_FRICTION = 1.5  # [-] largest friction of the measurements; contact with more friction sticks

# Motions at constant load. Lengths in [gel thicknesses] (tests/tacsim/physics/motion/test_load.py).
MAX_LOAD_STEP = 0.06  # longest path between two corrections
MAX_LOAD_CORRECTION = 0.025  # longest correction: larger ones open a contact, or press a contact that slips
INITIAL_LOAD_TRAVEL = 0.02  # assumed travel for a force change of 100 %, until the stiffness is measured
MAX_LOAD_TRAVEL = 0.6  # from the target along z: a validity limit, beyond it the load is out of reach
MAX_LOAD_CORRECTIONS = 60  # after one step of the path: a validity limit
INTERMEDIATE_LOAD_TOLERANCE = 0.1  # [load] allowed error between two steps of the path
