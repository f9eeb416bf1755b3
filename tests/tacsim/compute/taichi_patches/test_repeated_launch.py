"""A repeated launch does what Taichi's own launch does."""

import numpy as np
import pytest

from tacsim.compute.runtime import start_taichi, ti
from tacsim.compute.taichi_patches.repeated_launch import launch_kernel

Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Triples = ti.types.ndarray(dtype=ti.types.vector(3, ti.f32), ndim=2)
Weights = ti.types.argpack(triples=Triples, offsets=Floats)
Values = ti.types.argpack(values=Floats)


@ti.kernel
def add_weighted(factor: ti.i32, weights: Weights, share: ti.f32, result: Values, lengths: Floats):
    for i in range(result.values.shape[0]):
        lengths[i] = weights.triples.shape[1]
        for j in range(weights.triples.shape[1]):
            result.values[i] += factor * weights.triples[i, j][2] + share * weights.offsets[j]


def test_repeated_launches_take_other_arrays_of_other_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    start_taichi()

    def refuse(*_: object) -> None:
        raise AssertionError("Taichi's own launch was used")

    for factor, share, rows, columns in ((2, 0.5, 3, 2), (5, -1.0, 4, 1), (-1, 2.0, 1, 6)):
        triples = np.arange(3 * rows * columns, dtype=np.float32).reshape(rows, columns, 3)
        offsets = np.arange(columns, dtype=np.float32)
        values, lengths = np.ones(rows, np.float32), np.zeros(rows, np.float32)
        launch_kernel(add_weighted, factor, (triples, offsets), share, (values,), lengths)
        assert np.array_equal(values, 1.0 + factor * triples[..., 2].sum(axis=1) + share * offsets.sum())
        assert np.array_equal(lengths, np.full(rows, columns))
        monkeypatch.setattr(ti.lang.kernel_impl.Kernel, "launch_kernel", refuse)
