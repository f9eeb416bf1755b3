"""Whether a body is still one piece."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_LOOSE_SHARE = 0.01  # of a body's particles that may be off its largest piece; more is broken
LINK_SPACINGS = 2.0  # particles of one piece are nearer to each other, in spacings of the body at rest


def loose_share(points: NDArray[Any], volume: float) -> float:
    """Share of the particles (n, 3) [m] that do not belong to the largest piece of a body of `volume` [m^3].

    Two particles belong to one piece if they are nearer than LINK_SPACINGS times the spacing of n particles that fill
    the volume evenly: a gap of one missing particle is a crack.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    count = len(points)
    reach = LINK_SPACINGS * (volume / count) ** (1 / 3)
    pairs = KDTree(np.asarray(points, np.float64)).query_pairs(reach, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    return 1.0 - float(np.bincount(labels).max()) / count


def is_broken(points: NDArray[Any], volume: float) -> bool:
    """True if more than MAX_LOOSE_SHARE of a body is off its largest piece."""
    return loose_share(points, volume) > MAX_LOOSE_SHARE
