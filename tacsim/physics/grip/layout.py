"""Indices of the numbers in the small arrays of grips. Units: mm, N, MPa, wave speed 1.

The frame of a grip moves, in a step, with the mean motion of the pads that touch; at the start of a step its origin is
the object's centre and its axes are those of world.
"""

from tacsim.physics.exec.layout import Layout

# constants (grips, CONSTANTS) float32: of one grip in one step
_constants = Layout()
TURN = _constants.place(9)  # orientation of the object at the start, row by row
LOAD = _constants.place(3)  # weight and external force on the object x, y, z [N], world axes
TORQUE = _constants.place(3)  # external moment about its centre x, y, z [N mm], world axes
WEIGHT = _constants.place(3)  # weight alone x, y, z [N], world axes
WEIGHT_ARM = _constants.place(3)  # from its centre to its centre of mass at the start x, y, z [mm], world axes
SUPPORT = _constants.place(6)  # stiffness of its support: along x, y, z [N/mm], about x, y, z [N mm/rad], world axes
SUPPORT_LIMIT = _constants.place(2)  # of the support's force [N] and moment [N mm]
SUPPORT_AXES = _constants.place(3)  # 1: its force along world x, y, z counts against the limit, and can be a guide's
GUIDE_ROOM = _constants.place(2)  # where its stops are, along these axes, from the place at the start [mm]
SUPPORT_NUMBERS = _constants.size - SUPPORT
MIN_MASS = _constants.place()  # [MPa mm^3]
MIN_INERTIA = _constants.place()  # [MPa mm^5]
REACH = _constants.place()  # largest distance of a point of the object from its centre [mm]
MAX_SPEED = _constants.place()  # of a point of the object [-]
CLOSING_RATE = _constants.place()  # of their damping [1/mm]
MAX_CLOSING_SPEED = _constants.place()  # of pads that a force closes [-]
CLOSING_FORCE = _constants.place()  # with which each pad is pressed along its z axis [N]
CLOSING_RANGE = _constants.place(2)  # least and largest closing [mm]
TOLERANCE = _constants.place()  # of the balance of forces at rest [-]
MIN_FORCE = _constants.place()  # reference of that tolerance, at least [N]
CONSTANTS = _constants.size

# whole (grips, WHOLE) int32
_whole = Layout()
SUBSTEPS = _whole.place()  # at most, of this launch
MOVING = _whole.place()  # substeps in which the pads move
LAST = _whole.place()  # last substep: the kernel makes it smaller where forces have balanced
QUIET_SUBSTEPS = _whole.place()  # balanced in succession, after which a launch may end; 0: it does not end early
QUIET = _whole.place()  # substeps in succession whose forces were balanced
IS_CLOSING = _whole.place()  # 1: the pads close by CLOSING_FORCE; 0: they are at their given poses
LIMITED = _whole.place()  # substeps in which MAX_SPEED limited a motion
WHOLE = _whole.size

# objects (grips, OBJECT) float32: the state, in the frame of the grip
_object = Layout()
PLACE = _object.place(3)  # of its centre x, y, z [mm]
TURNED = _object.place(4)  # since the start of the step, quaternion x, y, z, w
VELOCITY = _object.place(3)  # x, y, z [-]
SPIN = _object.place(3)  # x, y, z [1/mm]
CLOSING = _object.place()  # of each pad along its z axis, from its given pose [mm]
CLOSING_SPEED = _object.place()  # [-]
STRETCH = _object.place(
    6
)  # displacement and turn of the object from where its support is without load [mm, rad], world
LAG = _object.place()  # largest difference of contact force and reaction of the backing, in the substep before [N]
IMBALANCE = _object.place()  # largest of forces, relative to the largest contact force [-]
OBJECT = _object.size

# patches (gels, PARTS, PATCH) float32: moments of the points that touch, about the pad's origin, in its axes
_patch = Layout()
COUNT = _patch.place()  # points
FIRST = _patch.place(3)  # sums of x, y, z [mm]
SQUARES = _patch.place(3)  # sums of x x, y y, z z [mm^2]
PRODUCTS = _patch.place(3)  # sums of y z, x z, x y [mm^2]
CONTACT = _patch.place(3)  # force on the gel in the last substep x, y, z [N]; of part 0 alone
PATCH = _patch.size

# rows of `frames` (grips, moving substeps + 1, pads + 1, FRAME_ROWS, 3): a pad's axes in the grip's frame (3 rows of a
# matrix), position [mm], velocity [-] and spin [1/mm]; the last frame: axes of the grip's frame in world, its origin
# minus that at the start, its velocity and spin, world axes
FRAME_ROWS = 6
