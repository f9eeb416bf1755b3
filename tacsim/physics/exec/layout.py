"""Indices of the numbers in the small arrays that kernels share with worlds. Units: mm, N, MPa, wave speed 1."""


class Layout:
    """Indices in one array, in the order of the requests."""

    def __init__(self) -> None:
        self.size = 0  # numbers so far

    def place(self, numbers: int = 1) -> int:
        """Index of the first of `numbers` consecutive numbers."""
        self.size += numbers
        return self.size - numbers


# params (environments, PARAMS) float32: constants of one environment
# two numbers in a row belong to gel 0 and gel 1
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
BODY_HARDENING = _params.place()  # increase of the limit by equivalent plastic strain [-]
BODY_MASS = _params.place()  # of a particle [N mm]: over wave speed^2
BODY_VOLUME = _params.place()  # of a particle [mm^3]
BODY_DAMPING = _params.place()  # rate [1/mm], against the driven affine motion
RIGID_MASS_SCALE = _params.place()  # factor by which the inertia for the body's total force is reduced [-]
STIFFNESS = _params.place(2)  # of the contact of one particle [N/mm], two; or of an indenter [MPa/mm]
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
MEAN_GRADIENT = _params.place(9)  # mean displacement gradient of the particles since that reference, row by row
EDGE_RADIUS = _params.place()  # of an indenter [mm]
OWN_WEIGHT = _params.place()  # weight of a node's own acceleration, force over mass; 1 is true inertia
FILTERED_WEIGHT = _params.place()  # weight of the filtered acceleration (gel/mass.py, body/mass.py)
LIMIT_RELAXATION_RATE = _params.place()  # rate at which the friction limit of an indenter follows the pressure [1/mm]
MEMORY_SHARE = _params.place()  # share of a change of the normal force that a contact's memory takes over in a substep
STIFFNESS_RATIO = _params.place(2)  # stiffness of particles' contacts in the previous launch over that in this one, two
PARAMS = _params.size

# counts (environments, COUNTS) int32
_counts = Layout()
ZERO = _counts.place()  # always 0: see tacsim.physics.exec.lanes.overwrite
STEPS = _counts.place()  # substeps of this launch
PARTICLES = _counts.place()
GRID = _counts.place(3)  # node counts x, y, z
SLAB = _counts.place(8)  # first node plane and the one after the last of part 0, 1, ...
KIND = _counts.place()  # of indenter
STRIDE = _counts.place()  # largest number of particles of an environment
CAPACITY = _counts.place()  # largest number of strips of grid nodes of an environment, in each copy
SHAPE_NODES = _counts.place(3)  # of an indenter's distance grid, number of loaded nodes along x, y, z
SHAPE_FIRST = _counts.place(3)  # number of the first loaded node of an indenter's distance grid along x, y, z
GRID_HAS_VELOCITIES = _counts.place()  # 1: the nodes have velocities of the previous launch; 0: particles give them
LINKS = _counts.place()  # largest number of pairs of a tied node and a full node, in each table
IMPULSE_LINKS = _counts.place(5)  # first pair of part 0, 1, ..., one after the last, by full nodes (body/tied_nodes.py)
VELOCITY_LINKS = _counts.place(5)  # the same by tied nodes
RECORD_INTERVAL = _counts.place()  # substeps between two records of the parts' numbers: see `RECORDS`
ELEMENTS = _counts.place(6)  # of gel 0 along x, y, z, and of gel 1
# first indices of gel 0 and gel 1 of an environment in the arrays of tacsim.physics.gel.gel.GelState
GEL_NODES = _counts.place(2)
GEL_SURFACE = _counts.place(2)
GEL_FORCES = _counts.place(2)
GEL_CORNERS = _counts.place(2)
GEL_LATTICE = _counts.place(2)  # in LANES numbers
COUNTS = _counts.size

# partial (environments, PARTS, NUMBERS) float32: results of each part
_partial = Layout()
SMALLEST_VOLUME = _partial.place()  # det F over the gel elements
OFF_GRID = _partial.place()  # particle substeps outside the grid
SMALLEST_STEP_VOLUME = _partial.place()  # det(I + dt C) over the particles
PEAK_SPEED = _partial.place()  # largest component of a particle's velocity
CAPPED = _partial.place()  # number of contact overlaps that were limited
OVERLAP = _partial.place()  # largest of the last substep [mm]
FORCE = _partial.place(12)  # on gel 0, gel 1: force x, y, z [N], moment x, y, z [N mm]; of the last substep
FORCE_SUM = _partial.place(6)  # of an indenter: FORCE of gel 0, summed over the substeps of this launch
BACKING = _partial.place(3)  # force of this part's gel on its backing [N], of the last substep
VELOCITY_SUM = _partial.place(3)  # sum of the particles' velocities
HOUSING_FORCE = _partial.place(6)  # force on the housing of gel 0, gel 1: x, y, z [N]; of the last substep
SQUARED_GREEN_STRAIN = _partial.place()  # largest |F^T F - I|^2 of a particle, F since the grid's reference
NUMBERS = _partial.size

# records (environments, RECORDS, PARTS, NUMBERS) float32: copies of `partial` within the launch, every RECORD_INTERVAL
RECORDS = 3

# rows of a body's particles, each with one number of all particles: float32
_particle_rows = Layout()
PLANE = _particle_rows.place(3)  # tangent plane x, y, z [1/mm] (tacsim.physics.body.surface)
POSITION = _particle_rows.place(3)  # x, y, z [mm]
STRAIN = _particle_rows.place(6)  # elastic e = b_e - I: xx, yy, zz, xy, xz, yz
PLASTIC_STRAIN = _particle_rows.place()  # equivalent plastic strain
VELOCITY = _particle_rows.place(3)  # x, y, z
AFFINE = _particle_rows.place(9)  # affine velocity dv/dX over the grid's reference, column by column [1/mm]
REFERENCE = _particle_rows.place(3)  # reference position on the grid, which stays while the body moves: x, y, z [mm]
GRADIENT = _particle_rows.place(9)  # displacement gradient H = F - I since the reference, column by column
PUSH = _particle_rows.place(3)  # velocity change by contact in this substep: x, y, z
PARTICLE_ROWS = _particle_rows.size
