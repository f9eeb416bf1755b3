"""Where each number stands in the small arrays that kernels share with worlds. Units: mm, N, MPa, wave speed 1."""

# params (environments, PARAMS) float32: constants of one environment
STEP = 0  # time step [mm]
GEL_SPACING = 1  # element edge [mm]
GEL_MU = 2  # [MPa]
GEL_LAMBDA = 3  # [MPa]
GEL_DENSITY = 4  # [MPa]: over wave speed^2
GEL_DAMPING = 5  # rate [1/mm]
BODY_CELL = 6  # grid spacing [mm]
BODY_MU = 7  # [MPa]
BODY_BULK = 8  # [MPa]
BODY_LIMIT = 9  # k = sigma_y / (2 mu), Frobenius norm [-]
BODY_HARDENING = 10  # growth of the limit by equivalent plastic strain [-]
BODY_MASS = 11  # of a particle [N mm]: over wave speed^2
BODY_VOLUME = 12  # of a particle [mm^3]
BODY_DAMPING = 13  # rate [1/mm], against the driven affine motion
RIGID_MASS_SCALE = 14  # how much lighter the body answers to its total force [-]
STIFFNESS = 15  # of one particle's contact [N/mm], or of the indenter's [MPa/mm]
FRICTION = 16  # of gel 0 and gel 1 [-]
HOUSING = 18  # below the gel's surface [mm]; negative: none
GRAVITY = 19  # acceleration x, y, z [1/mm]
ORIGIN = 22  # of the grid x, y, z [mm]
SHAPE = 25  # of an indenter: three sizes [mm]
SHAPE_ORIGIN = 28  # of its distance grid, node (0, 0, 0): x, y, z [mm]
SHAPE_SPACING = 31  # of its distance grid [mm]
CENTRE = 32  # of the particles at the launch's start x, y, z [mm]
INVERSE_INERTIA = 35  # inverse moment of inertia of the particles then: xx, yy, zz, xy, xz, yz [1/(MPa mm^5)]
REFERENCE_CENTRE = 41  # of the particles in the reference of the body's grid x, y, z [mm]
CARRIED = 44  # mean displacement gradient of the particles since then, row by row
EDGE_RADIUS = 53  # of an indenter [mm]
OWN = 54  # weight of a node's own acceleration, force over mass, in how it moves; 1 is true inertia
FILTERED = 55  # weight of that filtered by its neighbours' (tacsim.physics.gel.mass, tacsim.physics.body.mass)
LIMIT_FOLLOWS = 56  # rate at which the limit of an indenter's friction follows the pressure [1/mm]
PARAMS = 57

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
ELEMENTS = 20  # of a gel along x, y, z
SHAPE_FIRST = 23  # number of the first loaded node of an indenter's distance grid along x, y, z
GRID_MOVES = 26  # 1: the grid's nodes have velocities from the launch before; 0: particles bring them
LINKS = 27  # pairs of a light node of the grid and a leader that an environment has room for, in each order
PUSHES = 28  # first pair of part 0, 1, ..., and the one after the last, by the leaders (tacsim.physics.body.followers)
MOVES = 33  # the same by the light nodes
EVERY = 38  # substeps after which the parts' numbers are kept: see `RECORDS`
COUNTS = 39

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
