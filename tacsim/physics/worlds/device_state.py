"""The arrays of worlds on a device, and their copies on the host.

The host's copies are read and written with NumPy. They are downloaded when they are requested, not after each launch:
kernels compute what a launch needs of the state (tacsim.physics.worlds.survey), and the state that is restored after a
failed motion is stored on the device. Before a launch, changes of the host's copies are sent.
"""

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar

import numpy as np

from tacsim.compute.runtime import launching, ti
from tacsim.physics.body.moments import Moments
from tacsim.physics.body.plasticine import BodyState
from tacsim.physics.contact.contact import ContactHistory
from tacsim.physics.exec import layout
from tacsim.physics.exec.device_arrays import DeviceArrays
from tacsim.physics.exec.graph import Graph
from tacsim.physics.exec.lanes import PARTS, lanes, strip, vec3
from tacsim.physics.gel.gel import GelState
from tacsim.physics.worlds.device import hybrid_substeps, press_substeps
from tacsim.physics.worlds.survey import (
    BLOCKS,
    MOMENTS,
    NUMBERS,
    TOP,
    Survey,
    survey_of,
)
from tacsim.physics.worlds.survey_kernels import copy_outer_rows, hybrid_survey, press_survey, store_hybrid, store_press

OUTER_ROWS = layout.POSITION + 3  # of the particles, the first: tangent planes and positions

Numbers = tuple[np.ndarray, np.ndarray, np.ndarray]  # params, counts, partial: small, always on the host
Values = tuple[np.ndarray, int]  # distances from meshes, and their version, which changes with them


def runs_of(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """First and end of each run of consecutive numbers: [0, 1, 2, 5] gives 0 up to 3, and 5 up to 6."""
    starts = [n for i, n in enumerate(numbers) if i == 0 or numbers[i - 1] != n - 1]
    ends = [n + 1 for i, n in enumerate(numbers) if i == len(numbers) - 1 or numbers[i + 1] != n + 1]
    return list(zip(starts, ends, strict=True))


class DeviceState(ABC):
    """The arrays of a FemState on the device."""

    _substeps: ClassVar[Graph]
    _survey: ClassVar[Graph]
    _store: ClassVar[Graph]

    def __init__(self, gels: GelState, numbers: Numbers) -> None:
        self.arrays = DeviceArrays()
        self._gels, (self._params, self._counts, self._partial) = gels, numbers
        self._host_is_outdated = False  # kernels have changed the state since the last download
        self._host_is_exposed = True  # the host's copies may have changed since they were sent
        self._base = np.zeros((len(self._params), 3))  # origin of positions in a survey
        self._found: dict[str, np.ndarray] = {}  # results for the present state: survey, surfaces, particles
        self._surveys: dict[int, Survey] = {}  # of environments, from these results
        self._pending: set[int] = set()  # environments whose present state must be stored before it changes

    def _state(self) -> dict[str, tuple[np.ndarray, Any]]:
        """All arrays that a motion changes, without `partial`: the host's arrays and their types on the device, by the
        names of the kernels' parameters."""
        nodes, surface = self._gels.arguments()[:2]
        return {"nodes": (nodes, ti.f32), "surface": (surface, ti.f32)}

    @abstractmethod
    def _extra_arguments(self) -> dict[str, Any]:
        """Additional arguments of the kernels of such worlds."""

    def _particles(self, index: int) -> int:
        """Number of particles of an environment."""
        return 0

    # ------------------------------------------------------------ the host's copies

    def copy_to_host(self) -> None:
        """Downloads the state. Called before the host's copies are read or written."""
        if self._host_is_outdated:
            with launching():
                self.arrays.download(**{name: host for name, (host, _) in self._state().items()})
                self._host_is_outdated = False
        self._host_is_exposed = True

    def _copy_to_device(self) -> dict[str, Any]:
        """The state on the device, after sending changes of the host's copies."""
        if self._host_is_exposed:
            self._store_pending()
            self._gels.copy_surface()
            sent = self.arrays.sent_bytes
            try:
                for name, (host, dtype) in self._state().items():
                    self.arrays.upload(name, host, dtype)
            finally:
                if self.arrays.sent_bytes != sent:
                    self._found, self._surveys = {}, {}
            self._host_is_exposed = False
        return {name: self.arrays[name] for name in self._state()}

    @contextlib.contextmanager
    def with_state_before(self, moment: str) -> Iterator[None]:
        """Context in which the host's copies are those before the last "motion" (see `store_state`) or "launch"."""
        with launching():
            self._store_pending()
            self.copy_to_host()
            hosts = {name: host for name, (host, _) in self._state().items()}
            now = {name: host.copy() for name, host in hosts.items()}
            try:
                for name, host in hosts.items():
                    stored = self.arrays.download_copy(f"{name} before {moment}")
                    if stored.size == host.size:
                        host[...] = stored.reshape(host.shape)
                    else:  # the memory for grid nodes has grown since then
                        stored = stored.reshape(len(self._params), -1)
                        host.reshape(len(self._params), -1)[:, : stored.shape[1]] = stored
                yield
            finally:
                for name, host in hosts.items():
                    host[...] = now[name]

    # ------------------------------------------------------------ results for the present state

    @launching()
    def survey(self, index: int) -> Survey:
        """Results of the survey kernels for an environment."""
        found = self._surveyed()[index]
        if index not in self._surveys:
            spacings = [float(self._params[index, layout.GEL_SPACING + g]) for g in range(len(self._gels.gels))]
            self._surveys[index] = survey_of(found, spacings, self._particles(index), self._base[index])
        return self._surveys[index]

    def _surveyed(self) -> np.ndarray:
        """(E, NUMBERS)"""
        on_device = self._copy_to_device()
        if "survey" not in self._found:
            first = layout.REFERENCE_CENTRE
            self._base = self._params[:, first : first + 3].astype(np.float64)
            found = self.arrays.allocate("found", ti.f32, (len(self._params), NUMBERS))
            self._survey.run({**on_device, **self._common(), **self._extra_arguments(), "found": found})
            self._found["survey"] = self.arrays.download_copy("found")
        return self._found["survey"]

    @launching()
    def surface_displacements(self, index: int) -> list[np.ndarray]:
        """See `GelState.surface_displacements`."""
        self._copy_to_device()
        if "surfaces" not in self._found:
            self._found["surfaces"] = self.arrays.download_copy("surface")
        tops = []
        for g, gel in enumerate(self._gels.gels):
            nx, ny, _ = gel.elements
            first = self._counts[index, layout.GEL_SURFACE + g]
            whole = self._found["surfaces"][first : first + 4 * (nx + 3) * (ny + 3)].reshape(nx + 3, ny + 3, 4)
            tops.append(whole[1:-1, 1:-1, :3])
        return tops

    # ------------------------------------------------------------ launches

    @launching()
    def store_state(self, index: int) -> None:
        """Stores an environment's present state as the state before a motion."""
        self._copy_to_device()
        self._pending.add(index)

    def _store_pending(self) -> None:
        """Stores pending states, consecutive environments in one call: in a batch all motions begin before the first
        launch."""
        pending, self._pending = sorted(self._pending), set()
        for first, last in runs_of(pending):
            self._copy(first, last, "motion")

    def _copy(self, first: int, last: int, moment: str) -> None:
        """Copies environments `first` up to `last`; before a "launch" only those with substeps."""
        counts = self.arrays.upload("counts", self._counts, ti.i32)
        arguments = {
            "first": first, "last": last, "resting": int(moment == "motion"), "counts": counts,
            "margin": self._gels.margin, "no_margin": 0,
        }  # fmt: skip
        for name, (_, dtype) in self._state().items():
            arguments[name] = self.arrays[name]
            shape = self.arrays[name].shape
            arguments[f"stored_{name}"] = self.arrays.allocate(f"{name} before {moment}", dtype, shape)
        self._store.run(arguments)

    @launching()
    def run(self, drive: np.ndarray) -> None:
        """One launch; drive: (E, substeps, gels, 6, 3)."""
        highest = np.maximum(self._surveyed()[:, [TOP + 3, TOP + 7]], 0.0)  # surfaces before the first substep
        arguments = {
            **self._copy_to_device(), **self._common(), **self._extra_arguments(),
            "drive": self.arrays.upload("drive", drive, ti.f32),
            "ceiling": self.arrays.upload("ceiling", np.stack([highest, 0.0 * highest], axis=-1), ti.f32),
        }  # fmt: skip
        self._store_pending()
        self._copy(0, len(drive), "launch")
        arguments["clock"].fill(0)
        self.arrays.invalidate(*self._state(), "ceiling", "partial")
        self._host_is_outdated, self._found, self._surveys = True, {}, {}
        self._substeps.run(arguments, drive.shape[1])
        self.arrays.download(partial=self._partial)

    def _common(self) -> dict[str, Any]:
        """Arguments of the kernels of all worlds, without the state."""
        _, _, contact_force, corners, lattice = self._gels.arguments()
        return {
            "params": self.arrays.upload("params", self._params, ti.f32),
            "counts": self.arrays.upload("counts", self._counts, ti.i32),
            "partial": self.arrays.upload("partial", self._partial, ti.f32),
            "clock": self.arrays.allocate("clock", ti.i32, (2,)),
            "contact_force": self.arrays.allocate("contact_force", ti.f32, contact_force.shape),
            "corners": self.arrays.allocate("corners", ti.f32, corners.shape),
            "lattice": self.arrays.upload("lattice", lattice, lanes),
            "gels": len(self._gels.gels), "layers": max(gel.elements[2] for gel in self._gels.gels),
            "columns": self._gels.columns,
        }  # fmt: skip


class DevicePress(DeviceState):
    """State of indenters on gels."""

    _substeps, _survey, _store = press_substeps, press_survey, store_press

    def __init__(
        self, gels: GelState, numbers: Numbers, anchor: np.ndarray, pressure: np.ndarray, values: Callable[[], Values]
    ) -> None:  # fmt: skip
        super().__init__(gels, numbers)
        self._anchor, self._pressure, self._values = anchor, pressure, values

    def _state(self) -> dict[str, tuple[np.ndarray, Any]]:
        return {**super()._state(), "anchor": (self._anchor, vec3), "pressure": (self._pressure, ti.f32)}

    def _extra_arguments(self) -> dict[str, Any]:
        values, version = self._values()
        return {"values": self.arrays.upload_if_changed("values", values, ti.f32, version)}


class DeviceHybrid(DeviceState):
    """State of bodies between gels."""

    _substeps, _survey, _store = hybrid_substeps, hybrid_survey, store_hybrid

    def __init__(
        self, gels: GelState, numbers: Numbers, records: np.ndarray, body: BodyState,
        contact_history: Callable[[], np.ndarray],
    ) -> None:  # fmt: skip
        super().__init__(gels, numbers)
        self._records, self._body, self._contact_history = records, body, contact_history

    def _particles(self, index: int) -> int:
        return self._body.counts[index]

    def _state(self) -> dict[str, tuple[np.ndarray, Any]]:
        particles, _, velocities = self._body.arguments()
        own = {
            "particles": (particles, ti.f32), "velocities": (velocities, strip),
            "histories": (self._contact_history(), ContactHistory),
        }  # fmt: skip
        return {**super()._state(), **own}

    def _extra_arguments(self) -> dict[str, Any]:
        masses = self._body.arguments()[1]
        return {
            "masses": self.arrays.allocate("masses", strip, masses.shape[:-1]),
            "changes": self.arrays.allocate("changes", ti.f32, (self._body.changes.size,)),
            "records": self.arrays.allocate("records", ti.f32, self._records.shape),
            "sums": self.arrays.allocate("sums", ti.f32, (len(self._params), MOMENTS, BLOCKS)),
            "ends": self.arrays.upload("ends", self._body.links()[0], ti.i32),
            "shares": self.arrays.upload("shares", self._body.links()[1], ti.f32),
            "max_links": int(self._counts[:, layout.IMPULSE_LINKS + PARTS].max()),
            "max_particles": max(self._body.counts),
            "max_nodes": int(self._counts[:, layout.GRID : layout.GRID + 3].prod(axis=1).max()),
        }  # fmt: skip

    def _surveyed(self) -> np.ndarray:
        self._counts[:, layout.PARTICLES], self._counts[:, layout.STRIDE] = self._body.counts, self._body.rows.shape[2]
        return super()._surveyed()

    @launching()
    def run(self, drive: np.ndarray) -> None:
        self._extra_arguments()["masses"].fill(0)  # also after the grid, where particles off the grid are added
        super().run(drive)
        if (self._counts[:, layout.RECORD_INTERVAL] < self._counts[:, layout.STEPS]).any():
            self.arrays.download(records=self._records)

    def moments(self, index: int) -> Moments:
        found = self.survey(index).moments
        assert found is not None
        return found

    @launching()
    def positions_and_planes(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions [mm] and tangent planes [1/mm] of the particles of an environment, (n, 3) both."""
        on_device = self._copy_to_device()
        if "outside" not in self._found:
            outer = self.arrays.allocate("outside", ti.f32, (len(self._params), OUTER_ROWS, self._body.rows.shape[2]))
            copy_outer_rows(on_device["particles"], outer)
            self._found["outside"] = self.arrays.download_copy("outside")
        rows = self._found["outside"][index, :, : self._body.counts[index]]
        return rows[layout.POSITION : layout.POSITION + 3].T, rows[layout.PLANE : layout.PLANE + 3].T
