"""Forces, contact radii and heights by finite elements that share no code with tacsim, as numbers.

Our own axisymmetric solvers in double precision: biquadratic elements, nine Gauss points, Newton's method, no
inertia. The gel is neo-Hookean, E 0.145 MPa, nu 0.48, 4 mm thick, bonded below, a disc of the area of the shipped
square (radius 11.28 mm).

- **Press**: rigid ball, penalty of 200 MPa/mm, no friction, elements of 0.2 mm; with half of them no force changes by
  more than 0.5 %. Contact radii by 0.05 to 0.1 mm, known to 0.01 mm. With friction (return mapping, 0.05 mm a step)
  for the deep presses.
- **Punch and twist**: displacements given under a flat punch, elements graded to its rim, limit of 0.05 and 0.025 mm
  there. On a disc of 15 mm the wider punch has 1.4 % more force, which is the influence of the gel's outline. The
  twist is that of a bonded disc, linear, over 16/3 G a^3.
- **Slide**: all of the contact slides. 0.1 mm deep: a linear layer in three dimensions (FFT, normal and tangential
  compliance, points that move with the gel; grids of 0.125 and 0.0625 mm agree to 0.01 %). At 0.5 mm depth that is too
  large (0.331, 0.677, 1.196), and the pressures of the resting contact, without gel in front of the ball, are too small
  (0.305, 0.611, 1.018); the numbers used are an estimate between them.
- **Cylinder**: 10 x 10 mm, multiplicative Hencky plasticity by radial return, E 0.5 MPa, nu 0.45, uniaxial yield
  stress 30 kPa, between two such gels, friction 0.6 by penalty, half a model by symmetry, 0.02 mm a step, elements of
  0.25 mm; with 0.5 mm forces are 0.3 to 0.4 % larger. From the first cycle on, forces are constant.
"""

from __future__ import annotations

WORDS = "solvers that share nothing with ours (benchmarks/truth/finite_elements.py)"

SHEAR_MODULUS = 0.145 / (2 * 1.48)  # of the gel [MPa]

# (radius, depth) [mm]: force [N], contact radius [mm]
BALLS = {
    (2.0, 0.1): (0.01255, 0.452), (2.0, 0.3): (0.07093, 0.813),
    (2.0, 0.5): (0.1613, 1.035), (2.0, 1.0): (0.4959, 1.466),
    (4.0, 0.1): (0.01900, 0.665), (4.0, 0.3): (0.1147, 1.204),
    (4.0, 0.5): (0.2754, 1.578), (4.0, 1.0): (0.9497, 2.308),
    (8.0, 0.1): (0.02952, 0.966), (8.0, 0.3): (0.1959, 1.792),
    (8.0, 0.5): (0.5038, 2.368), (8.0, 1.0): (1.9461, 3.557),
}  # fmt: skip
BALL_WITH_FRICTION = {1.0: 1.004, 1.5: 2.258, 2.0: 4.190, 2.5: 7.011}  # R 4 mm, friction 0.6; depth [mm]: force [N]
PUNCHES = {2.0: 0.1412, 3.0: 0.2889}  # radius [mm]: force [N], 0.1 mm deep
TWISTS = {2.0: 1.010, 3.0: 1.030}  # radius [mm]: moment over 16/3 G a^3 and angle
# (depth [mm], friction): drag over normal force of a ball R 4 mm
SLIDES = {
    (0.1, 0.3): 0.304,
    (0.1, 0.6): 0.609,
    (0.1, 1.0): 1.022,
    (0.5, 0.3): 0.32,
    (0.5, 0.6): 0.647,
    (0.5, 1.0): 1.098,
}

# closed by [mm]: force [N], height [mm]
CYLINDER = {1.0: (2.054, 9.548), 2.0: (2.799, 8.729), 3.0: (3.137, 7.789)}
CYCLED = 2.897  # force [N] at 2.3 mm, reached from 2.0 mm, in every cycle
