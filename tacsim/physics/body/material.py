"""The plasticine's law inside kernels: Hencky elasticity with von Mises return mapping.

Symmetric 3x3 matrices are stored as 6 numbers (xx, yy, zz, xy, xz, yz). Polynomials of one symmetric matrix commute
and are symmetric, so their products have 6 numbers: no SVD, no eigenvalues, no branch near equal eigenvalues.
The same laws in float64 NumPy: benchmarks/truth/laws.py.
"""

import math

from tacsim.compute.runtime import ti
from tacsim.physics.body.tuning import MAX_EXP_ARGUMENT, MAX_LOG1P_ARGUMENT, MAX_LOG_ARGUMENT

vec3 = ti.types.vector(3, ti.f32)
vec6 = ti.types.vector(6, ti.f32)
mat3 = ti.types.matrix(3, 3, ti.f32)

LN_2 = math.log(2.0)
SQRT_2_3 = math.sqrt(2.0 / 3.0)  # equivalent plastic strain over the norm of the plastic strain increment
UNREACHABLE_LIMIT = 1e9  # elastic limit of a body that never yields: it runs no return mapping


@ti.func
def full_matrix(s):
    return mat3([[s[0], s[3], s[4]], [s[3], s[1], s[5]], [s[4], s[5], s[2]]])


@ti.func
def symmetric_product(a, b):
    """a b of two commuting symmetric matrices."""
    return vec6(
        a[0] * b[0] + a[3] * b[3] + a[4] * b[4],
        a[3] * b[3] + a[1] * b[1] + a[5] * b[5],
        a[4] * b[4] + a[5] * b[5] + a[2] * b[2],
        a[0] * b[3] + a[3] * b[1] + a[4] * b[5],
        a[0] * b[4] + a[3] * b[5] + a[4] * b[2],
        a[3] * b[4] + a[1] * b[5] + a[5] * b[2],
    )


@ti.func
def plus_identity(s, c):
    """s + c I."""
    return vec6(s[0] + c, s[1] + c, s[2] + c, s[3], s[4], s[5])


@ti.func
def second_invariant(s):
    """Sum of the principal 2x2 minors (second invariant)."""
    return s[0] * s[1] - s[3] * s[3] + s[0] * s[2] - s[4] * s[4] + s[1] * s[2] - s[5] * s[5]


@ti.func
def determinant(s):
    return s[0] * (s[1] * s[2] - s[5] * s[5]) - s[3] * (s[3] * s[2] - s[5] * s[4]) + s[4] * (s[3] * s[5] - s[1] * s[4])


@ti.func
def inverse(s):
    c0 = s[1] * s[2] - s[5] * s[5]
    c3 = s[4] * s[5] - s[3] * s[2]
    c4 = s[3] * s[5] - s[4] * s[1]
    r = 1.0 / (s[0] * c0 + s[3] * c3 + s[4] * c4)
    return r * vec6(c0, s[0] * s[2] - s[4] * s[4], s[0] * s[1] - s[3] * s[3], c3, c4, s[3] * s[4] - s[0] * s[5])


@ti.func
def squared_norm(s):
    return s[0] * s[0] + s[1] * s[1] + s[2] * s[2] + 2.0 * (s[3] * s[3] + s[4] * s[4] + s[5] * s[5])


@ti.func
def frobenius_norm(s):
    return ti.sqrt(squared_norm(s))


@ti.func
def log1p_series(z):
    """ln(1 + x) = 2 artanh(z) with z = x / (2 + x), by its series: accurate in f32 for |x| up to 0.4, however small.

    Terms are evaluated in pairs (Estrin) to shorten the dependency chain.
    """
    q = z * z
    q2 = q * q
    return 2.0 * z * ((1.0 + q / 3.0) + q2 * (0.2 + q / 7.0) + q2 * q2 * (1.0 / 9.0 + q / 11.0))


@ti.func
def log1p(x):
    """ln(1 + x), accurate in f32 for small x."""
    y = 0.0
    if ti.abs(x) < MAX_LOG1P_ARGUMENT:
        y = log1p_series(x / (2.0 + x))
    else:
        y = ti.log(1.0 + x)
    return y


@ti.func
def lanes_log(x):
    """ln x of lanes, without a branch, root or quotient; x > 0, error under float32's rounding, also near 1.

    x = 2^n (1 + z) with 1 + z from sqrt(1/2) to sqrt(2); the polynomial is that of Cephes (Moshier 1992).
    """
    bits = ti.bit_cast(x, ti.i32)
    n = (bits - 0x3F3504F3) >> 23  # less the bits of sqrt(1/2)
    z = ti.bit_cast(bits - (n << 23), ti.f32) - 1.0
    z2 = z * z
    low = (3.3333331174e-1 - 2.4999993993e-1 * z) + z2 * (2.0000714765e-1 - 1.6668057665e-1 * z)
    high = (1.4249322787e-1 - 1.2420140846e-1 * z) + z2 * (1.1676998740e-1 - 1.1514610310e-1 * z)
    rest = z2 * z * (low + z2 * z2 * (high + z2 * z2 * 7.0376836292e-2)) - 0.5 * z2
    return z + rest + ti.cast(n, ti.f32) * LN_2


@ti.func
def log_pade(a):
    """log(I + a) by the [3/3] Padé approximant; relative error below 1.4e-5 for |a| up to 0.5.

    The quotient N(a) / D(a) of two cubics is itself a quadratic c0 + c1 a + c2 a^2, since a^3 = I1 a^2 - I2 a + I3
    (Cayley-Hamilton): three scalar equations in place of two matrix products and an inverse.
    """
    a2 = symmetric_product(a, a)
    i1, i2, i3 = a[0] + a[1] + a[2], second_invariant(a), determinant(a)
    n = vec3(11.0 * i3, 60.0 - 11.0 * i2, 60.0 + 11.0 * i1)  # 60 a + 60 a^2 + 11 a^3 by powers 0, 1, 2
    d0 = vec3(60.0 + 3.0 * i3, 90.0 - 3.0 * i2, 36.0 + 3.0 * i1)  # 60 + 90 a + 36 a^2 + 3 a^3
    d1 = vec3(d0[2] * i3, d0[0] - d0[2] * i2, d0[1] + d0[2] * i1)  # the same times a
    d2 = vec3(d1[2] * i3, d1[0] - d1[2] * i2, d1[1] + d1[2] * i1)  # times a^2
    r0, r1, r2 = d1.cross(d2), d2.cross(d0), d0.cross(d1)  # Cramer's rule for c0 d0 + c1 d1 + c2 d2 = n
    scale = 1.0 / d0.dot(r0)
    return plus_identity((scale * n.dot(r1)) * a + (scale * n.dot(r2)) * a2, scale * n.dot(r0))


@ti.func
def square_root(a):
    """r with (I + r)^2 = I + a, by the Denman-Beavers iteration (quadratic; a > -I)."""
    y = plus_identity(a, 1.0)
    z = vec6(1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
    for _ in range(8):
        y, z = 0.5 * (y + inverse(z)), 0.5 * (z + inverse(y))
    return plus_identity(y, -1.0)


@ti.func
def logarithm(a):
    """log(I + a). Large strain (|a| > 0.5) falls back on log(I + a) = 2^n log((I + a)^(1/2^n)), n <= 3."""
    scale = 1.0
    root = a
    if frobenius_norm(a) > MAX_LOG_ARGUMENT:
        for _ in range(3):
            if frobenius_norm(root) > MAX_LOG_ARGUMENT:
                root = square_root(root)
                scale *= 2.0
    return scale * log_pade(root)


@ti.func
def exponential_series(x):
    """exp(x) - I for tr x = 0 by its Taylor series to 4th order, error below |x|^5 / 120."""
    i2, i3 = second_invariant(x), determinant(x)  # x^3 = -i2 x + i3, since tr x = 0
    return plus_identity((1.0 - i2 / 6.0 + i3 / 24.0) * x + (0.5 - i2 / 24.0) * symmetric_product(x, x), i3 / 6.0)


@ti.func
def exponential_minus_identity(x, norm):
    """exp(x) - I for tr x = 0; norm: |x|.

    Large strain (stiff yield, or long hardening) is halved first: exp(x) = exp(x / 2^n)^(2^n), n <= 4.
    """
    halvings = 0
    small = norm
    for _ in range(4):
        if small > MAX_EXP_ARGUMENT:
            small *= 0.5
            halvings += 1
    y = exponential_series((small / norm) * x)
    for _ in range(halvings):
        y = 2.0 * y + symmetric_product(y, y)
    return y


@ti.func
def volume_preserving(e, shrink):
    """b_e / J^(2/3) - I, from shrink = J^(-2/3)."""
    return plus_identity(e * shrink, shrink - 1.0)


@ti.func
def elastic_after_return(growth, shrink):
    """e of the volume-preserving part of growth + I, at the volume J = shrink^(-3/2)."""
    # det - 1 of the truncated series
    excess = growth[0] + growth[1] + growth[2] + second_invariant(growth) + determinant(growth)
    volume = (1.0 - excess / 3.0) / shrink
    return plus_identity(growth * volume, volume - 1.0)


@ti.func
def inverse_cube_root_term(z):
    """t with (1 - t) / (1 + t) = (1 + x)^(-1/3) for |x| up to 0.4, where z = x / (2 + x): tanh(artanh(z) / 3) by its
    series."""
    q = z * z
    q2 = q * q
    low, high = 1.0 / 3.0 + 8.0 / 81.0 * q, 40.0 / 729.0 + 728.0 / 19683.0 * q
    return z * (low + q2 * high + q2 * q2 * (43768.0 / 1594323.0))


@ti.func
def small_strain(e):
    """log J, dev(eps) and J^(2/3) of b_e = I + e, for elastic strain up to about 0.2. It has no branch, so lanes are
    computed together.

    Also returns 1 where the strain is larger and the other results are not valid, else 0.
    """
    x = e[0] + e[1] + e[2] + second_invariant(e) + determinant(e)  # det(I + e) - 1
    z = x / (2.0 + x)
    t = inverse_cube_root_term(z)
    shape = volume_preserving(e, (1.0 - t) / (1.0 + t))
    strain = 0.5 * log_pade(shape)
    strain = plus_identity(strain, -(strain[0] + strain[1] + strain[2]) / 3.0)  # dev(eps)
    large = ti.select(ti.abs(x) > MAX_LOG1P_ARGUMENT, 1, 0) | ti.select(squared_norm(shape) > MAX_LOG_ARGUMENT**2, 1, 0)
    return 0.5 * log1p_series(z), strain, (1.0 + t) / (1.0 - t), large


@ti.func
def stress_small_strain(e, mu, bulk):
    """Kirchhoff stress of a body that never yields, and 1 where `small_strain` is not valid, else 0."""
    log_j, strain, _, large = small_strain(e)
    return plus_identity(2.0 * mu * strain, bulk * log_j), large


@ti.func
def return_small_strain(e, plastic_strain, mu, bulk, yield_strain, hardening):
    """Return mapping (see `hencky_return`) for elastic strain up to about 0.2, without a branch: see `small_strain`.

    Also returns 1 where the strain is larger and the other results are not valid, else 0.
    """
    log_j, strain, grow, large = small_strain(e)
    strain2, i2, i3 = symmetric_product(strain, strain), second_invariant(strain), determinant(strain)
    norm = ti.sqrt(strain2[0] + strain2[1] + strain2[2])
    yield_limit, hardening_factor = yield_strain + hardening * plastic_strain, 1.0 / (1.0 + SQRT_2_3 * hardening)
    remaining = 1.0 - hardening_factor * ti.max(0.0, 1.0 - yield_limit / ti.max(norm, 1e-12))  # share of the strain
    # exp(2 remaining strain) - I by `exponential_series`, of invariants 4 remaining^2 i2 and 8 remaining^3 i3
    j2, j3 = 4.0 * remaining * remaining * i2, 8.0 * remaining * remaining * remaining * i3
    first, second = 2.0 * remaining * (1.0 - j2 / 6.0 + j3 / 24.0), 4.0 * remaining * remaining * (0.5 - j2 / 24.0)
    growth = plus_identity(first * strain + second * strain2, j3 / 6.0)
    excess = j2 * j3 / 24.0 + (3.0 * j3 * j3 - 2.0 * j2 * j2 * j2) / 144.0  # det - 1 of the cut series
    volume = (1.0 - excess / 3.0) * grow
    returned = plus_identity(growth * volume, volume - 1.0)
    yields = norm > yield_limit
    elastic = vec6([ti.select(yields, returned[c], e[c]) for c in ti.static(range(6))])
    large = large | ti.select(2.0 * remaining * norm > MAX_EXP_ARGUMENT, 1, 0)
    new_plastic_strain = plastic_strain + SQRT_2_3 * hardening_factor * ti.max(0.0, norm - yield_limit)
    return elastic, new_plastic_strain, plus_identity(2.0 * mu * remaining * strain, bulk * log_j), large


@ti.func
def return_any_strain(e, plastic_strain, mu, bulk, yield_strain, hardening):
    """Return mapping (see `hencky_return`) for any strain."""
    log_j = 0.5 * log1p(e[0] + e[1] + e[2] + second_invariant(e) + determinant(e))  # det(I + e) - 1
    shrink = ti.exp(-2.0 / 3.0 * log_j)
    strain = 0.5 * logarithm(volume_preserving(e, shrink))
    strain = plus_identity(strain, -(strain[0] + strain[1] + strain[2]) / 3.0)  # dev(eps)
    norm = frobenius_norm(strain)
    elastic = e
    yield_limit = yield_strain + hardening * plastic_strain
    new_plastic_strain = plastic_strain
    if norm > yield_limit:  # delta gamma = |dev eps| - sigma_y / (2 mu) > 0: back to the yield surface, volume kept
        gamma = (norm - yield_limit) / (1.0 + SQRT_2_3 * hardening)
        new_plastic_strain = plastic_strain + SQRT_2_3 * gamma
        strain *= (norm - gamma) / norm
        elastic = elastic_after_return(exponential_minus_identity(2.0 * strain, 2.0 * (norm - gamma)), shrink)
    return elastic, new_plastic_strain, plus_identity(2.0 * mu * strain, bulk * log_j)


@ti.func
def hencky_return(e, plastic_strain, mu, bulk, yield_strain, hardening):
    """Hencky elasticity with von Mises return mapping (seed paper, eq. 1 and 2), on e = b_e - I.

    For tests and benchmarks: `return_block` (transfers.py) calls the two parts separately.

    e: trial elastic left Cauchy-Green strain minus identity; plastic_strain: equivalent, before this step;
    yield_strain: sigma_y / (2 mu), Frobenius norm; linear isotropic hardening (Simo & Hughes 1998, box 3.1) adds
    hardening * plastic_strain to it. Returns the elastic e after the return, the new plastic strain, and the Kirchhoff
    stress tau = 2 mu dev(eps) + K ln(J) I.
    """
    elastic, new_plastic_strain, tau, large = return_small_strain(e, plastic_strain, mu, bulk, yield_strain, hardening)
    if large != 0:
        elastic, new_plastic_strain, tau = return_any_strain(e, plastic_strain, mu, bulk, yield_strain, hardening)
    return elastic, new_plastic_strain, tau


@ti.func
def transport_strain(e, d):
    """e of f b f^T, with f = I + d and b = I + e. I is not added, so small strains stay exact in f32."""
    m = d + d @ full_matrix(e)
    t = m + m.transpose() + m @ d.transpose()
    return e + vec6(t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2])


@ti.func
def gradient(rows: ti.template(), lane):
    """H = F - I, from its columns."""
    return mat3([[rows[3 * j + i, lane] for j in range(3)] for i in range(3)])


@ti.func
def inverse_of(h):
    """F^-1 of F = I + h."""
    f = h + mat3([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    a, b, c = [vec3([f[i, j] for j in range(3)]) for i in range(3)]
    bc, ca, ab = b.cross(c), c.cross(a), a.cross(b)
    return (1.0 / a.dot(bc)) * mat3([[bc[i], ca[i], ab[i]] for i in range(3)])


@ti.func
def green_strain(h):
    """F^T F - I of F = I + h, which a rotation does not change."""
    g = h + h.transpose() + h.transpose() @ h
    return vec6(g[0, 0], g[1, 1], g[2, 2], g[0, 1], g[0, 2], g[1, 2])
