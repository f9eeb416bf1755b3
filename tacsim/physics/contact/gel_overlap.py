"""How deep two gels lie in one another: contact knows body and gel, not gel and gel, so this is watched instead.

Lengths in mm, as in kernels.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tacsim.physics.gel.gel import GelParams

Floats = NDArray[np.floating]


def gel_overlap(gels: Sequence[GelParams], tops: Sequence[Floats], rotations: Floats, origins: Floats) -> float:
    """The deepest that a surface node of one gel lies below the surface of the other [mm]; 0 where they are apart.

    tops: displacements of the surfaces of both `gels` (nx + 1, ny + 1, 3), each in its sensor's frame [mm]; rotations
    (2, 3, 3) and origins (2, 3) [mm] of the sensors in the world. Heights between nodes are linear, and those of a
    surface are taken where its nodes rest: its sideways displacement is left out.
    """
    if apart(gels, box_round(tops[1]), float(tops[0][..., 2].max()), rotations, origins):
        return 0.0
    from scipy.ndimage import map_coordinates

    deepest = 0.0
    for here, there in ((0, 1), (1, 0)):
        points = tops[there].astype(np.float64)
        points[..., :2] += _places(gels[there])
        points = (points.reshape(-1, 3) @ rotations[there].T + origins[there] - origins[here]) @ rotations[here]
        heights, half, spacing = tops[here][..., 2], np.array(gels[here].half), gels[here].spacing
        low = points[(points[:, 2] < heights.max()) & (np.abs(points[:, :2]) < half).all(axis=1)]
        if len(low):
            surface = map_coordinates(heights, ((low[:, :2] + half) / spacing).T, order=1)
            deepest = max(deepest, float((surface - low[:, 2]).max()))
    return deepest


def _places(gel: GelParams) -> Floats:
    """(nx + 1, ny + 1, 2) where the surface's nodes rest [mm]."""
    axes = [np.arange(n + 1) * gel.spacing for n in gel.elements[:2]]
    places: Floats = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) - np.array(gel.half)
    return places


def box_round(top: Floats) -> tuple[float, float, float, float]:
    """Largest |x|, largest |y|, lowest z and highest z of a surface's displacements (nx + 1, ny + 1, 3) [mm]."""
    x, y, z = (top[..., d] for d in range(3))
    return float(np.abs(x).max()), float(np.abs(y).max()), float(z.min()), float(z.max())


def apart(
    gels: Sequence[GelParams], second: Sequence[float], highest: float, rotations: Floats, origins: Floats
) -> bool:  # fmt: skip
    """Whether boxes round the displaced surfaces leave room between them along the first sensor's normal: mostly they
    do, and this is 20 times quicker than every node. Not where anything is NaN.

    second: `box_round` the second gel's surface; highest: node of the first's [mm].
    """
    reach = [gels[1].half[d] + second[d] for d in (0, 1)]
    x, y, z = rotations[0][:, 2] @ rotations[1]
    lowest = min(z * second[2], z * second[3]) - abs(x) * reach[0] - abs(y) * reach[1]
    return bool(rotations[0][:, 2] @ (origins[1] - origins[0]) + lowest > highest)
