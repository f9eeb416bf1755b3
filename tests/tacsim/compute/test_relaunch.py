"""A kernel launched again does what Taichi's own launch does."""

import numpy as np

from tacsim.compute import relaunch
from tacsim.compute.relaunch import launch
from tacsim.compute.runtime import start, ti

Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Triples = ti.types.ndarray(dtype=ti.types.vector(3, ti.f32), ndim=2)


@ti.kernel
def weighted(factor: ti.i32, values: Floats, triples: Triples):
    for i in range(values.shape[0]):
        for j in range(triples.shape[1]):
            values[i] += factor * triples[i, j][2]


def made(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    triples = np.arange(3 * rows * columns, dtype=np.float32).reshape(rows, columns, 3)
    return np.ones(rows, np.float32), triples


def test_later_launches_take_other_arrays_of_other_shapes() -> None:
    start()
    for factor, rows, columns in ((2, 3, 2), (5, 4, 1), (-1, 1, 6)):
        values, triples = made(rows, columns)
        launch(weighted, factor, values, triples)
        assert np.array_equal(values, 1.0 + factor * triples[..., 2].sum(axis=1))
    assert relaunch._known[weighted] is not None  # else Taichi's own launch was tested


def test_where_taichi_is_another_its_own_launch_is_used() -> None:
    class Kernel:
        calls = 0

        def __call__(self, *arguments: object) -> None:
            self.calls += 1

    kernel = Kernel()
    for _ in range(3):
        launch(kernel, 1)
    assert kernel.calls == 3 and relaunch._known.pop(kernel) is None
