"""Where each number stands in the small arrays that kernels share with worlds. Units: mm, N, MPa, wave speed 1."""


class Layout:
    """Places in one array, in the order in which they are asked for."""

    def __init__(self) -> None:
        self.size = 0  # numbers so far

    def place(self, numbers: int = 1) -> int:
        """The first of so many numbers."""
        self.size += numbers
        return self.size - numbers


# params (environments, PARAMS) float32: constants of one environment
# two numbers in a row are of gel 0 and gel 1
_params = Layout()
STEP = _params.place()  # time step [mm]
GEL_SPACING = _params.place(2)  # element edge [mm], two
GEL_MU = _params.place(2)  # [MPa], two
GEL_LAMBDA = _params.place(2)  # [MPa], two
GEL_DENSITY = _params.place(2)  # [MPa]: over wave speed^2, two
GEL_DAMPING = _params.place(2)  # rate [1/mm], two
BODY_CELL = _params.place()  # grid spacing [mm]
BODY_MU = _params.place()  # [MPa]
BODY_BULK = _params.place()  # [MPa]
BODY_LIMIT = _params.place()  # k = sigma_y / (2 mu), Frobenius norm [-]
BODY_HARDENING = _params.place()  # growth of the limit by equivalent plastic strain [-]
BODY_MASS = _params.place()  # of a particle [N mm]: over wave speed^2
BODY_VOLUME = _params.place()  # of a particle [mm^3]
BODY_DAMPING = _params.place()  # rate [1/mm], against the driven affine motion
RIGID_MASS_SCALE = _params.place()  # how much lighter the body answers to its total force [-]
STIFFNESS = _params.place(2)  # of one particle's contact [N/mm], two; or of the indenter's [MPa/mm]
FRICTION = _params.place(2)  # [-], two
HOUSING = _params.place(2)  # below the gel's surface [mm], two; negative: none
GRAVITY = _params.place(3)  # acceleration x, y, z [1/mm]
ORIGIN = _params.place(3)  # of the grid x, y, z [mm]
SHAPE = _params.place(3)  # of an indenter: three sizes [mm]
SHAPE_ORIGIN = _params.place(3)  # of its distance grid, node (0, 0, 0): x, y, z [mm]
SHAPE_SPACING = _params.place()  # of its distance grid [mm]
CENTRE = _params.place(3)  # of the particles at the launch's start x, y, z [mm]
INVERSE_INERTIA = _params.place(6)  # of the particles then, xx, yy, zz, xy, xz, yz [1/(MPa mm^5)]
REFERENCE_CENTRE = _params.place(3)  # of the particles in the reference of the body's grid x, y, z [mm]
CARRIED = _params.place(9)  # mean displacement gradient of the particles since then, row by row
EDGE_RADIUS = _params.place()  # of an indenter [mm]
OWN = _params.place()  # weight of a node's own acceleration, force over mass, in how it moves; 1 is true inertia
FILTERED = _params.place()  # weight of the acceleration filtered by its neighbours' (gel/mass.py, body/mass.py)
LIMIT_FOLLOWS = _params.place()  # rate at which the limit of an indenter's friction follows the pressure [1/mm]
MEMORY = _params.place()  # share of a change of the normal force that a contact's memory takes in a substep
SPRINGS = _params.place(2)  # stiffness of particles' contacts in the launch before over that in this one, two
PARAMS = _params.size

# counts (environments, COUNTS) int32
_counts = Layout()
ZERO = _counts.place()  # always 0: see tacsim.physics.exec.lanes.overwrite
STEPS = _counts.place()  # substeps of this launch
PARTICLES = _counts.place()
GRID = _counts.place(3)  # node counts x, y, z
SLAB = _counts.place(8)  # first node plane and the one after the last of part 0, 1, ...
KIND = _counts.place()  # of indenter
STRIDE = _counts.place()  # particles that an environment has room for
CAPACITY = _counts.place()  # strips of grid nodes that an environment has room for, in each copy
SHAPE_NODES = _counts.place(3)  # of an indenter's distance grid, how many are loaded along x, y, z
SHAPE_FIRST = _counts.place(3)  # number of the first loaded node of an indenter's distance grid along x, y, z
GRID_MOVES = _counts.place()  # 1: the grid's nodes have velocities from the launch before; 0: particles bring them
LINKS = _counts.place()  # room of an environment for pairs of a light node of the grid and a leader, in each order
PUSHES = _counts.place(5)  # first pair of part 0, 1, ..., one after the last, by the leaders (body/followers.py)
MOVES = _counts.place(5)  # the same by the light nodes
EVERY = _counts.place()  # substeps after which the parts' numbers are kept: see `RECORDS`
ELEMENTS = _counts.place(6)  # of gel 0 along x, y, z, and of gel 1
# where gel 0 and gel 1 of an environment begin in the arrays of tacsim.physics.gel.gel.GelState
GEL_NODES = _counts.place(2)
GEL_SURFACE = _counts.place(2)
GEL_FORCES = _counts.place(2)
GEL_CORNERS = _counts.place(2)
GEL_LATTICE = _counts.place(2)  # in LANES numbers
COUNTS = _counts.size

# partial (environments, PARTS, NUMBERS) float32: what each part saw or summed
_partial = Layout()
SMALLEST_VOLUME = _partial.place()  # det F over the gel elements
OFF_GRID = _partial.place()  # particle substeps outside the grid
SMALLEST_STEP_VOLUME = _partial.place()  # det(I + dt C) over the particles
FASTEST = _partial.place()  # largest component of a particle's velocity
CAPPED = _partial.place()  # contact overlaps cut to the largest allowed
OVERLAP = _partial.place()  # largest of the last substep [mm]
FORCE = _partial.place(12)  # on gel 0, gel 1: force x, y, z [N], moment x, y, z [N mm]; of the last substep
BACKING = _partial.place(3)  # force of this part's gel on its backing [N], of the last substep
VELOCITY_SUM = _partial.place(3)  # sum of the particles' velocities
HOUSING_FORCE = _partial.place(6)  # force on the housing of gel 0, gel 1: x, y, z [N]; of the last substep
GREEN = _partial.place()  # largest |F^T F - I|^2 of a particle, F its deformation since the grid's reference
NUMBERS = _partial.size

# records (environments, RECORDS, PARTS, NUMBERS) float32: `partial` as it was within the launch, every so many substeps
RECORDS = 3

# rows of a body's particles, one number of all of them each: float32
_particle_rows = Layout()
PLANE = _particle_rows.place(3)  # tangent plane x, y, z [1/mm] (tacsim.physics.body.surface)
POSITION = _particle_rows.place(3)  # x, y, z [mm]
STRAIN = _particle_rows.place(6)  # elastic e = b_e - I: xx, yy, zz, xy, xz, yz
PLASTIC_STRAIN = _particle_rows.place()  # equivalent plastic strain
VELOCITY = _particle_rows.place(3)  # x, y, z
AFFINE = _particle_rows.place(9)  # affine velocity dv/dX over the grid's reference, column by column [1/mm]
REFERENCE = _particle_rows.place(3)  # place on the grid, which stays while the body moves: x, y, z [mm]
GRADIENT = _particle_rows.place(9)  # displacement gradient H = F - I since then, column by column
PUSH = _particle_rows.place(3)  # change of velocity that contact has given it in this substep: x, y, z
PARTICLE_ROWS = _particle_rows.size
