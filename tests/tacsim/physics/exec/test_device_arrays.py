"""Arrays on a device that has no room for them."""

from __future__ import annotations

from typing import Any

import pytest

from tacsim.physics.exec import device_arrays


def test_device_without_memory_raises_memory_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_room(*_: Any) -> None:
        raise RuntimeError("[cuda_driver.h:operator()@92]\nCUDA_ERROR_OUT_OF_MEMORY: out of memory")

    monkeypatch.setattr(device_arrays.ti, "ndarray", no_room)
    with pytest.raises(
        MemoryError,
        match=r"no memory on the device for 'nodes', an array of \(70, 3\).*OUT_OF_MEMORY.*a coarser preset",
    ):
        device_arrays.DeviceArrays().allocate("nodes", device_arrays.ti.f32, (70, 3))
