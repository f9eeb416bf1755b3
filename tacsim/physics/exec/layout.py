"""Where each number stands in the small arrays that kernels share with worlds. Units: mm, N, MPa, wave speed 1."""

# params (environments, PARAMS) float32: constants of one environment
# two numbers in a row are of gel 0 and gel 1
STEP = 0  # time step [mm]
GEL_SPACING = 1  # element edge [mm], two
GEL_MU = 3  # [MPa], two
GEL_LAMBDA = 5  # [MPa], two
GEL_DENSITY = 7  # [MPa]: over wave speed^2, two
GEL_DAMPING = 9  # rate [1/mm], two
BODY_CELL = 11  # grid spacing [mm]
BODY_MU = 12  # [MPa]
BODY_BULK = 13  # [MPa]
BODY_LIMIT = 14  # k = sigma_y / (2 mu), Frobenius norm [-]
BODY_HARDENING = 15  # growth of the limit by equivalent plastic strain [-]
BODY_MASS = 16  # of a particle [N mm]: over wave speed^2
BODY_VOLUME = 17  # of a particle [mm^3]
BODY_DAMPING = 18  # rate [1/mm], against the driven affine motion
RIGID_MASS_SCALE = 19  # how much lighter the body answers to its total force [-]
STIFFNESS = 20  # of one particle's contact [N/mm], two; or of the indenter's [MPa/mm]
FRICTION = 22  # [-], two
HOUSING = 24  # below the gel's surface [mm], two; negative: none
GRAVITY = 26  # acceleration x, y, z [1/mm]
ORIGIN = 29  # of the grid x, y, z [mm]
SHAPE = 32  # of an indenter: three sizes [mm]
SHAPE_ORIGIN = 35  # of its distance grid, node (0, 0, 0): x, y, z [mm]
SHAPE_SPACING = 38  # of its distance grid [mm]
CENTRE = 39  # of the particles at the launch's start x, y, z [mm]
INVERSE_INERTIA = 42  # inverse moment of inertia of the particles then: xx, yy, zz, xy, xz, yz [1/(MPa mm^5)]
REFERENCE_CENTRE = 48  # of the particles in the reference of the body's grid x, y, z [mm]
CARRIED = 51  # mean displacement gradient of the particles since then, row by row
EDGE_RADIUS = 60  # of an indenter [mm]
OWN = 61  # weight of a node's own acceleration, force over mass, in how it moves; 1 is true inertia
FILTERED = 62  # weight of that filtered by its neighbours' (tacsim.physics.gel.mass, tacsim.physics.body.mass)
LIMIT_FOLLOWS = 63  # rate at which the limit of an indenter's friction follows the pressure [1/mm]
MEMORY = 64  # share of a change of the normal force that the memory of a contact follows each substep; 0 in real time
SPRINGS = 65  # stiffness of particles' contacts in the launch before over that in this one, two
PARAMS = 67

# counts (environments, COUNTS) int32
ZERO = 0  # always 0: see tacsim.physics.exec.lanes.overwrite
STEPS = 1  # substeps of this launch
PARTICLES = 2
GRID = 3  # node counts x, y, z
SLAB = 6  # first node plane and the one after the last of part 0, 1, ...
KIND = 14  # of indenter
STRIDE = 15  # particles that an environment has room for
CAPACITY = 16  # strips of grid nodes that an environment has room for, in each copy
SHAPE_NODES = 17  # of an indenter's distance grid, how many are loaded along x, y, z
SHAPE_FIRST = 20  # number of the first loaded node of an indenter's distance grid along x, y, z
GRID_MOVES = 23  # 1: the grid's nodes have velocities from the launch before; 0: particles bring them
LINKS = 24  # pairs of a light node of the grid and a leader that an environment has room for, in each order
PUSHES = 25  # first pair of part 0, 1, ..., and the one after the last, by the leaders (tacsim.physics.body.followers)
MOVES = 30  # the same by the light nodes
EVERY = 35  # substeps after which the parts' numbers are kept: see `RECORDS`
ELEMENTS = 36  # of gel 0 along x, y, z, and of gel 1
# where gel 0 and gel 1 of an environment begin in the arrays of tacsim.physics.gel.gel.GelState
GEL_NODES = 42
GEL_SURFACE = 44
GEL_FORCES = 46
GEL_CORNERS = 48
GEL_LATTICE = 50  # in LANES numbers
COUNTS = 52

# partial (environments, PARTS, NUMBERS) float32: what each part saw or summed
SMALLEST_VOLUME = 0  # det F over the gel elements
OFF_GRID = 1  # particle substeps outside the grid
SMALLEST_STEP_VOLUME = 2  # det(I + dt C) over the particles
FASTEST = 3  # largest component of a particle's velocity
CAPPED = 4  # contact overlaps cut to the largest allowed
OVERLAP = 5  # largest of the last substep [mm]
FORCE = 6  # on gel 0, gel 1: force x, y, z [N], moment x, y, z [N mm]; of the last substep
BACKING = 18  # force of this part's gel on its backing [N], of the last substep
VELOCITY_SUM = 21  # sum of the particles' velocities
HOUSING_FORCE = 24  # force on the housing of gel 0, gel 1: x, y, z [N]; of the last substep
GREEN = 30  # largest |F^T F - I|^2 of a particle, F its deformation since the grid's reference
NUMBERS = 31

# records (environments, RECORDS, PARTS, NUMBERS) float32: `partial` as it was within the launch, every so many substeps
RECORDS = 3

# rows of a body's particles, one number of all of them each: float32
PLANE = 0  # tangent plane x, y, z [1/mm] (tacsim.physics.body.surface)
POSITION = 3  # x, y, z [mm]
STRAIN = 6  # elastic e = b_e - I: xx, yy, zz, xy, xz, yz
PLASTIC_STRAIN = 12  # equivalent plastic strain
VELOCITY = 13  # x, y, z
AFFINE = 16  # affine velocity dv/dX over the grid's reference, column by column [1/mm]
REFERENCE = 25  # place on the grid, which stays while the body moves: x, y, z [mm]
GRADIENT = 28  # displacement gradient H = F - I since then, column by column
PUSH = 37  # change of velocity that contact has given it in this substep: x, y, z
PARTICLE_ROWS = 40
