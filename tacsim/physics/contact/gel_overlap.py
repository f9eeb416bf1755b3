"""How deep two gels lie in one another: contact knows body and gel, not gel and gel, so this is watched instead.

Lengths in mm, as in kernels.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tacsim.physics.gel.gel import GelParams

Floats = NDArray[np.floating]


def gel_overlap(params: GelParams, tops: Floats, rotations: Floats, origins: Floats) -> float:
    """The deepest that a surface node of one gel lies below the surface of the other [mm]; 0 where they are apart.

    tops: (2, nx + 1, ny + 1, 3) displacements of both gels' surfaces, each in its sensor's frame [mm]; rotations
    (2, 3, 3) and origins (2, 3) [mm] of the sensors in the world. Heights between nodes are linear, and those of a
    surface are taken where its nodes rest: its sideways displacement is left out.
    """
    if apart(params, box_round(tops[1]), float(tops[0, ..., 2].max()), rotations, origins):
        return 0.0
    from scipy.ndimage import map_coordinates

    half = np.array(params.half)
    at = np.stack(np.meshgrid(*[np.arange(n) * params.spacing for n in tops.shape[1:3]], indexing="ij"), axis=-1) - half
    deepest = 0.0
    for here, there in ((0, 1), (1, 0)):
        points = tops[there].astype(np.float64)
        points[..., :2] += at
        points = (points.reshape(-1, 3) @ rotations[there].T + origins[there] - origins[here]) @ rotations[here]
        heights = tops[here][..., 2]
        low = points[(points[:, 2] < heights.max()) & (np.abs(points[:, :2]) < half).all(axis=1)]
        if len(low):
            surface = map_coordinates(heights, ((low[:, :2] + half) / params.spacing).T, order=1)
            deepest = max(deepest, float((surface - low[:, 2]).max()))
    return deepest


def box_round(top: Floats) -> tuple[float, float, float, float]:
    """Largest |x|, largest |y|, lowest z and highest z of a surface's displacements (nx + 1, ny + 1, 3) [mm]."""
    x, y, z = (top[..., d] for d in range(3))
    return float(np.abs(x).max()), float(np.abs(y).max()), float(z.min()), float(z.max())


def apart(
    params: GelParams, second: Sequence[float], highest: float, rotations: Floats, origins: Floats
) -> bool:  # fmt: skip
    """Whether boxes round the displaced surfaces leave room between them along the first sensor's normal: mostly they
    do, and this is 20 times quicker than every node. Not where anything is NaN.

    second: `box_round` the second gel's surface; highest: node of the first's [mm].
    """
    reach = [params.half[d] + second[d] for d in (0, 1)]
    x, y, z = rotations[0][:, 2] @ rotations[1]
    lowest = min(z * second[2], z * second[3]) - abs(x) * reach[0] - abs(y) * reach[1]
    return bool(rotations[0][:, 2] @ (origins[1] - origins[0]) + lowest > highest)
