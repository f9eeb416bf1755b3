"""Where the arrays of worlds are when a device computes them: there.

The host has copies, which everybody reads and writes with NumPy. They come back when somebody asks for them, and not
after a launch: what a launch must know of the state, kernels find out (tacsim.physics.worlds.survey), and the state to
which a motion returns if it fails is kept on the device. Before a launch is sent what has been written to the host's
copies since they were asked for.
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
from tacsim.physics.worlds.survey_kernels import hybrid_survey, keep_hybrid, keep_press, press_survey, take_outer

OUTER_ROWS = layout.POSITION + 3  # of the particles, the first: tangent planes and positions

Numbers = tuple[np.ndarray, np.ndarray, np.ndarray]  # params, counts, partial: small, so the host always has them
Values = tuple[np.ndarray, int]  # distances from meshes, and their version: another whenever they have changed


def runs_of(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Where neighbours among ascending numbers begin and end: [0, 1, 2, 5] is 0 up to 3, and 5 up to 6."""
    starts = [n for i, n in enumerate(numbers) if i == 0 or numbers[i - 1] != n - 1]
    ends = [n + 1 for i, n in enumerate(numbers) if i == len(numbers) - 1 or numbers[i + 1] != n + 1]
    return list(zip(starts, ends, strict=True))


class DeviceState(ABC):
    """The arrays of a FemState on the device."""

    _substeps: ClassVar[Graph]
    _survey: ClassVar[Graph]
    _keep: ClassVar[Graph]

    def __init__(self, gels: GelState, numbers: Numbers) -> None:
        self.arrays = DeviceArrays()
        self._gels, (self._params, self._counts, self._partial) = gels, numbers
        self._ahead = False  # kernels have written what the host does not have yet
        self._shown = True  # the host's copies may have been written to since they were sent
        self._base = np.zeros((len(self._params), 3))  # what places in a survey are relative to
        self._found: dict[str, np.ndarray] = {}  # what is known of the present state: survey, surfaces, particles
        self._surveys: dict[int, Survey] = {}  # of environments, from that
        self._due: set[int] = set()  # environments whose present state is to be kept before anything changes it

    def _state(self) -> dict[str, tuple[np.ndarray, Any]]:
        """All that a motion changes, but for `partial`: the host's arrays, and what they consist of on the device, by
        the names of the kernels' parameters."""
        nodes, surface = self._gels.arguments()[:2]
        return {"nodes": (nodes, ti.f32), "surface": (surface, ti.f32)}

    @abstractmethod
    def _own(self) -> dict[str, Any]:
        """What else kernels of such worlds take."""

    def _particles(self, index: int) -> int:
        """How many an environment has."""
        return 0

    # ------------------------------------------------------------ the host's copies

    def bring_back(self) -> None:
        """Before anybody reads or writes the host's copies."""
        if self._ahead:
            with launching():
                self.arrays.download(**{name: host for name, (host, _) in self._state().items()})
                self._ahead = False
        self._shown = True

    def _send(self) -> dict[str, Any]:
        """The state on the device as anybody has left it."""
        if self._shown:
            self._keep_due()
            self._gels.refresh()
            sent = self.arrays.sent
            try:
                for name, (host, dtype) in self._state().items():
                    self.arrays.upload(name, host, dtype)
            finally:
                if self.arrays.sent != sent:
                    self._found, self._surveys = {}, {}
            self._shown = False
        return {name: self.arrays[name] for name in self._state()}

    @contextlib.contextmanager
    def as_kept(self, moment: str) -> Iterator[None]:
        """While this lasts, the host's copies are what they were before the last "motion" (see `keep`) or "launch"."""
        with launching():
            self._keep_due()
            self.bring_back()
            hosts = {name: host for name, (host, _) in self._state().items()}
            now = {name: host.copy() for name, host in hosts.items()}
            try:
                for name, host in hosts.items():
                    kept = self.arrays.look(f"{name} before {moment}")
                    if kept.size == host.size:
                        host[...] = kept.reshape(host.shape)
                    else:  # room for more nodes of grids since then
                        kept = kept.reshape(len(self._params), -1)
                        host.reshape(len(self._params), -1)[:, : kept.shape[1]] = kept
                yield
            finally:
                for name, host in hosts.items():
                    host[...] = now[name]

    # ------------------------------------------------------------ what is asked of the present state

    @launching()
    def survey(self, index: int) -> Survey:
        """What kernels find in an environment."""
        found = self._surveyed()[index]
        if index not in self._surveys:
            spacings = [float(self._params[index, layout.GEL_SPACING + g]) for g in range(len(self._gels.gels))]
            self._surveys[index] = survey_of(found, spacings, self._particles(index), self._base[index])
        return self._surveys[index]

    def _surveyed(self) -> np.ndarray:
        """(E, NUMBERS)"""
        there = self._send()
        if "survey" not in self._found:
            first = layout.REFERENCE_CENTRE
            self._base = self._params[:, first : first + 3].astype(np.float64)
            found = self.arrays.allocate("found", ti.f32, (len(self._params), NUMBERS))
            self._survey.run({**there, **self._common(), **self._own(), "found": found})
            self._found["survey"] = self.arrays.look("found")
        return self._found["survey"]

    @launching()
    def tops(self, index: int) -> list[np.ndarray]:
        """See GelState.tops."""
        self._send()
        if "surfaces" not in self._found:
            self._found["surfaces"] = self.arrays.look("surface")
        tops = []
        for g, gel in enumerate(self._gels.gels):
            nx, ny, _ = gel.elements
            first = self._counts[index, layout.GEL_SURFACE + g]
            whole = self._found["surfaces"][first : first + 4 * (nx + 3) * (ny + 3)].reshape(nx + 3, ny + 3, 4)
            tops.append(whole[1:-1, 1:-1, :3])
        return tops

    # ------------------------------------------------------------ launches

    @launching()
    def keep(self, index: int) -> None:
        """Keeps an environment's present state as that before a motion."""
        self._send()
        self._due.add(index)

    def _keep_due(self) -> None:
        """Neighbours in one call: in a batch all motions begin before the first launch."""
        due, self._due = sorted(self._due), set()
        for first, last in runs_of(due):
            self._copy(first, last, "motion")

    def _copy(self, first: int, last: int, moment: str) -> None:
        """Of environments `first` up to `last`; before a "launch" of those only that take part in it."""
        counts = self.arrays.upload("counts", self._counts, ti.i32)
        arguments = {
            "first": first, "last": last, "resting": int(moment == "motion"), "counts": counts,
            "margin": self._gels.margin, "no_margin": 0,
        }  # fmt: skip
        for name, (_, dtype) in self._state().items():
            arguments[name] = self.arrays[name]
            arguments[f"kept_{name}"] = self.arrays.allocate(f"{name} before {moment}", dtype, self.arrays[name].shape)
        self._keep.run(arguments)

    @launching()
    def run(self, drive: np.ndarray) -> None:
        """One launch; drive: (E, substeps, gels, 6, 3)."""
        highest = np.maximum(self._surveyed()[:, [TOP + 3, TOP + 7]], 0.0)  # surfaces before the first substep
        arguments = {
            **self._send(), **self._common(), **self._own(), "drive": self.arrays.upload("drive", drive, ti.f32),
            "ceiling": self.arrays.upload("ceiling", np.stack([highest, 0.0 * highest], axis=-1), ti.f32),
        }  # fmt: skip
        self._keep_due()
        self._copy(0, len(drive), "launch")
        arguments["clock"].fill(0)
        self.arrays.forget(*self._state(), "ceiling", "partial")
        self._ahead, self._found, self._surveys = True, {}, {}
        self._substeps.run(arguments, drive.shape[1])
        self.arrays.download(partial=self._partial)

    def _common(self) -> dict[str, Any]:
        """What kernels of all worlds take, but for the state."""
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
    """Of indenters on gels."""

    _substeps, _survey, _keep = press_substeps, press_survey, keep_press

    def __init__(
        self, gels: GelState, numbers: Numbers, anchor: np.ndarray, pressure: np.ndarray, values: Callable[[], Values]
    ) -> None:  # fmt: skip
        super().__init__(gels, numbers)
        self._anchor, self._pressure, self._values = anchor, pressure, values

    def _state(self) -> dict[str, tuple[np.ndarray, Any]]:
        return {**super()._state(), "anchor": (self._anchor, vec3), "pressure": (self._pressure, ti.f32)}

    def _own(self) -> dict[str, Any]:
        values, version = self._values()
        return {"values": self.arrays.upload_if_changed("values", values, ti.f32, version)}


class DeviceHybrid(DeviceState):
    """Of bodies between gels."""

    _substeps, _survey, _keep = hybrid_substeps, hybrid_survey, keep_hybrid

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

    def _own(self) -> dict[str, Any]:
        masses = self._body.arguments()[1]
        return {
            "masses": self.arrays.allocate("masses", strip, masses.shape[:-1]),
            "changes": self.arrays.allocate("changes", ti.f32, (self._body.changes.size,)),
            "records": self.arrays.allocate("records", ti.f32, self._records.shape),
            "sums": self.arrays.allocate("sums", ti.f32, (len(self._params), MOMENTS, BLOCKS)),
            "ends": self.arrays.upload("ends", self._body.links()[0], ti.i32),
            "shares": self.arrays.upload("shares", self._body.links()[1], ti.f32),
            "most_links": int(self._counts[:, layout.PUSHES + PARTS].max()),
            "most_particles": max(self._body.counts),
            "most_nodes": int(self._counts[:, layout.GRID : layout.GRID + 3].prod(axis=1).max()),
        }  # fmt: skip

    def _surveyed(self) -> np.ndarray:
        self._counts[:, layout.PARTICLES], self._counts[:, layout.STRIDE] = self._body.counts, self._body.rows.shape[2]
        return super()._surveyed()

    @launching()
    def run(self, drive: np.ndarray) -> None:
        self._own()["masses"].fill(0)  # also where particles that left the grid have been added
        super().run(drive)
        if (self._counts[:, layout.EVERY] < self._counts[:, layout.STEPS]).any():
            self.arrays.download(records=self._records)

    def moments(self, index: int) -> Moments:
        found = self.survey(index).moments
        assert found is not None
        return found

    @launching()
    def outside(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions [mm] and tangent planes [1/mm] of the particles of an environment, (n, 3) both."""
        there = self._send()
        if "outside" not in self._found:
            outer = self.arrays.allocate("outside", ti.f32, (len(self._params), OUTER_ROWS, self._body.rows.shape[2]))
            take_outer(there["particles"], outer)
            self._found["outside"] = self.arrays.look("outside")
        rows = self._found["outside"][index, :, : self._body.counts[index]]
        return rows[layout.POSITION : layout.POSITION + 3].T, rows[layout.PLANE : layout.PLANE + 3].T
