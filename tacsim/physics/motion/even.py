"""Even motions of objects in the frames of gel pads, in kernel units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.physics.units import MM

Floats = NDArray[np.float64]


def even_drive(starts: Floats, ends: Floats, substeps: int, time: float) -> NDArray[np.float32]:
    """Drives (k, substeps, 1, 6, 3) from one pose to another, both (k, 7) [m], in a kernel `time` [mm]."""
    from scipy.spatial.transform import Rotation

    share = np.arange(1, substeps + 1) / substeps
    before, after = Rotation.from_quat(starts[:, 3:]), Rotation.from_quat(ends[:, 3:])
    shift, turn = (ends[:, :3] - starts[:, :3]) * MM, (after * before.inv()).as_rotvec()
    drive = np.empty((len(ends), substeps, 1, 6, 3))
    between = Rotation.from_rotvec((share[:, None] * turn[:, None]).reshape(-1, 3)).as_matrix()
    drive[:, :, 0, :3] = between.reshape(len(ends), substeps, 3, 3) @ before.as_matrix()[:, None]
    drive[:, :, 0, 3] = starts[:, None, :3] * MM + share[:, None] * shift[:, None]
    drive[:, :, 0, 4], drive[:, :, 0, 5] = (shift / time)[:, None], (turn / time)[:, None]
    return drive.astype(np.float32)


def mean_velocities(drives: NDArray[np.float32]) -> Floats:
    """(n, 6) velocity at the pads' origins and spin of the objects, in the middle of drives (n, substeps, 1, 6, 3)."""
    ends = drives[:, [0, -1], 0, 3:].astype(np.float64)
    (x, y, z), (vx, vy, vz), (rx, ry, rz) = (0.5 * (ends[:, 0] + ends[:, 1])).transpose(1, 2, 0)
    return np.stack([vx - ry * z + rz * y, vy - rz * x + rx * z, vz - rx * y + ry * x, rx, ry, rz], axis=1)
