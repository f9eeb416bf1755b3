"""Arrays on a device, and copies of them on the host."""

from typing import Any

import numpy as np

from tacsim.compute.runtime import ti
from tacsim.physics.exec.lanes import vec4


class DeviceArrays:
    """Arrays on the device, by name: made when first asked for, and anew when a shape changes."""

    def __init__(self) -> None:
        self.sent, self.brought = 0, 0  # bytes so far
        self._there: dict[str, Any] = {}
        self._known: dict[str, np.ndarray] = {}  # what these hold, where that has been sent or brought back last
        self._versions: dict[str, int] = {}

    def __getitem__(self, name: str) -> Any:
        return self._there[name]

    def allocate(self, name: str, dtype: Any, shape: tuple[int, ...]) -> Any:
        """An array that only the device uses; zeros at first. Raises MemoryError where there is no room for it."""
        there = self._there.get(name)
        if there is None or there.shape != shape:
            try:
                there = ti.ndarray(dtype, shape)
                there.fill(0)
            except RuntimeError as error:
                raise MemoryError(
                    f"no room on the device for '{name}', an array of {shape}, beside {len(self._there)} others "
                    f"({str(error).splitlines()[-1]}): use a coarser preset, fewer worlds a batch, or a larger device"
                ) from error
            self._there[name] = there
            self._known.pop(name, None)
        return there

    def upload(self, name: str, host: np.ndarray, dtype: Any) -> Any:
        """A copy of `host`, whose last axis is the vector if dtype is one. Sent only where a bit of it differs from
        what the device holds: few write to what they have asked for, and to compare takes a twentieth."""
        there = self.allocate(name, dtype, host.shape[:-1] if isinstance(dtype, type(vec4)) else host.shape)
        known = self._known.get(name)
        if known is None or not np.array_equal(known.view(np.int32), host.view(np.int32)):  # as bits: NaN equals NaN
            self._known[name] = host.copy()
            self.sent += host.nbytes
            there.from_numpy(self._known[name])
        return there

    def upload_if_changed(self, name: str, host: np.ndarray, dtype: Any, version: int) -> Any:
        """The same of an array that seldom changes: copied only if it has another `version` than what is there."""
        if self._versions.get(name) != version:
            self.upload(name, host, dtype)
            self._versions[name] = version
        return self._there[name]

    def look(self, name: str) -> np.ndarray:
        """A copy of what the device has by a name."""
        found: np.ndarray = self._there[name].to_numpy()
        self.brought += found.nbytes
        return found

    def download(self, **hosts: np.ndarray) -> None:
        """Copies back into these arrays what the device has by their names."""
        for name, host in hosts.items():
            self._known[name] = self.look(name).reshape(host.shape)
            host[...] = self._known[name]

    def forget(self, *names: str) -> None:
        """Of arrays that kernels will change: unless brought back, also by an interruption, they are sent again."""
        for name in names:
            self._known.pop(name, None)
