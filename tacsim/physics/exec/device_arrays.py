"""Arrays on a device, and copies of them on the host."""

from typing import Any

import numpy as np

from tacsim.compute.runtime import ti
from tacsim.physics.exec.lanes import vec4


class DeviceArrays:
    """Arrays on the device, by name: allocated at the first request, and again when a shape changes."""

    def __init__(self) -> None:
        self.sent_bytes, self.received_bytes = 0, 0  # bytes so far
        self._arrays: dict[str, Any] = {}
        self._host_copies: dict[str, np.ndarray] = {}  # their contents as last sent or received
        self._versions: dict[str, int] = {}

    def __getitem__(self, name: str) -> Any:
        return self._arrays[name]

    def allocate(self, name: str, dtype: Any, shape: tuple[int, ...]) -> Any:
        """An array that only the device uses, initially zero. Raises MemoryError where the memory is too small."""
        array = self._arrays.get(name)
        if array is None or array.shape != shape:
            try:
                array = ti.ndarray(dtype, shape)
                array.fill(0)
            except RuntimeError as error:
                raise MemoryError(
                    f"no memory on the device for '{name}', an array of {shape}, in addition to {len(self._arrays)} "
                    f"others ({str(error).splitlines()[-1]}): use a coarser preset, fewer worlds a batch, or a larger "
                    f"device"
                ) from error
            self._arrays[name] = array
            self._host_copies.pop(name, None)
        return array

    def upload(self, name: str, host: np.ndarray, dtype: Any) -> Any:
        """A copy of `host`, whose last axis is the vector if dtype is one. It is sent only if it differs from the
        device's copy: most arrays do not change, and the comparison takes a twentieth of the time."""
        array = self.allocate(name, dtype, host.shape[:-1] if isinstance(dtype, type(vec4)) else host.shape)
        known = self._host_copies.get(name)
        if known is None or not np.array_equal(known.view(np.int32), host.view(np.int32)):  # as bits: NaN equals NaN
            self._host_copies[name] = host.copy()
            self.sent_bytes += host.nbytes
            array.from_numpy(self._host_copies[name])
        return array

    def upload_if_changed(self, name: str, host: np.ndarray, dtype: Any, version: int) -> Any:
        """The same for an array that rarely changes: copied only if `version` differs from that of the last copy."""
        if self._versions.get(name) != version:
            self.upload(name, host, dtype)
            self._versions[name] = version
        return self._arrays[name]

    def download_copy(self, name: str) -> np.ndarray:
        """A copy of an array of the device on the host."""
        found: np.ndarray = self._arrays[name].to_numpy()
        self.received_bytes += found.nbytes
        return found

    def download(self, **hosts: np.ndarray) -> None:
        """Copies the device's arrays of these names into the given arrays of the host."""
        for name, host in hosts.items():
            self._host_copies[name] = self.download_copy(name).reshape(host.shape)
            host[...] = self._host_copies[name]

    def invalidate(self, *names: str) -> None:
        """To be called before kernels change these arrays: they are sent again unless they are downloaded first, also
        after an interruption."""
        for name in names:
            self._host_copies.pop(name, None)
