"""Tactile sensors in a MuJoCo scene: gel pads at its sites, which hold, drag and let go of its objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from tacsim.control import ObjectDropped as ObjectDropped
from tacsim.interface import FloatArray, Image
from tacsim.models.scene import Gel, GelSurface, Indenter, Preset, Scene, Shape
from tacsim.models.sensor import SensorModel
from tacsim.physics.failure.health import LaunchSpan, SimulationDiverged
from tacsim.sim.engines.implicit_step import Response, step_with_wrenches
from tacsim.sim.engines.mujoco_module import load_mujoco
from tacsim.sim.engines.mujoco_objects import (
    MujocoObject,
    find_object,
    find_site,
    require_no_contact,
    require_stable_step,
)
from tacsim.sim.pads import TactilePads


class TouchSensor:
    """Gel pads in one MuJoCo scene. `step` takes the place of `mj_step`; all else of the scene stays as it is.

    A pad is a site: its origin is the middle of the gel's undeformed surface, its z axis points out of the gel. The
    gel's forces act on the site's body and on the object; MuJoCo's own contact between both must be off.
    """

    def __init__(
        self, model: Any, data: Any, sites: Sequence[str], objects: str | Sequence[str], *, gel: Gel | None = None,
        friction: float | None = None, geometry: Mapping[str, Shape] | None = None, preset: Preset = "learn",
        substeps: int | None = None, sensor: SensorModel | None = None,
    ) -> None:  # fmt: skip
        """See :meth:`batch`, which makes several."""
        self._join(
            *self._describe(model, data, sites, objects, gel or Gel(), friction, geometry or {}, preset),
            substeps,
            sensor,
        )

    @classmethod
    def batch(
        cls, scenes: Sequence[tuple[Any, Any]], sites: Sequence[str], objects: str | Sequence[str], *,
        gel: Gel | None = None, friction: float | None = None, geometry: Mapping[str, Shape] | None = None,
        preset: Preset = "learn", substeps: int | None = None, sensor: SensorModel | None = None,
    ) -> list[Self]:  # fmt: skip
        """Sensors in several scenes, whose gels `step_together` advances in one launch; each has the bits that it has
        alone.

        Args:
            scenes: MjModel and MjData of each. They belong to the caller: gravity, controls and applied forces act as
                always.
            sites: names of the pads' sites.
            objects: name of the geom that each pad touches, or of a body with one geom; one name: of all pads.
            gel: of all pads; None: the default gel.
            friction: of objects against gels; None: the geom's sliding friction.
            geometry: by object: its shape, needed for a mesh, otherwise taken from the model.
            preset: mesh of the gels, see docs/physics.md.
            substeps: of the gels in a step; None: the default of `GelPads`.
            sensor: whose pictures are rendered; None: none.

        Raises:
            ImportError: MuJoCo is missing or has another major version.
            ValueError: for a pad without a site, an object that is not there, that MuJoCo and the gels describe
                differently, of mass 0, or that MuJoCo's own contact touches where the gel is; for a step too long for
                the gel's stiffness; for an integrator without one evaluation a step; and what `GelPads` raises.
        """
        options = objects, gel or Gel(), friction, geometry or {}, preset
        sensors = [cls.__new__(cls) for _ in scenes]
        parts = [
            each._describe(model, data, sites, *options) for each, (model, data) in zip(sensors, scenes, strict=True)
        ]
        steps = {step for _, step in parts}
        if len(steps) > 1:
            raise ValueError(f"the scenes of a batch have timesteps of {sorted(steps)} s: give all the same")
        pads = TactilePads([scene for own, _ in parts for scene in own], steps.pop(), substeps, sensor=sensor)
        for number, each in enumerate(sensors):
            each._use(pads, number * len(sites))
        return sensors

    def _describe(
        self, model: Any, data: Any, sites: Sequence[str], objects: str | Sequence[str], gel: Gel,
        friction: float | None, geometry: Mapping[str, Shape], preset: Preset,
    ) -> tuple[list[Scene], float]:  # fmt: skip
        """Finds pads and objects; returns the scene of each pad, and the time of a step."""
        mujoco = load_mujoco()
        self.model, self.data = model, data
        if int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4):
            raise ValueError("integrator RK4 evaluates forces four times a step: use Euler, implicit or implicitfast")
        self.sites = tuple([sites] if isinstance(sites, str) else sites)
        if not self.sites:
            raise ValueError("give the name of at least one site, a pad")
        names = [objects] * len(self.sites) if isinstance(objects, str) else list(objects)
        if len(names) != len(self.sites):
            raise ValueError(f"{len(names)} objects for {len(self.sites)} pads: give one for each, or one for all")
        unknown = sorted(set(geometry) - set(names))
        if unknown:
            raise ValueError(f"geometry of '{unknown[0]}', which is none of the objects {sorted(set(names))}")
        found = {name: find_object(model, name, geometry.get(name), friction) for name in dict.fromkeys(names)}
        self._sites = [find_site(model, site) for site in self.sites]
        self._objects = [found[name] for name in names]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_factorM(model, data)
        scenes = []
        for site, name, item in zip(self._sites, self.sites, self._objects, strict=True):
            require_no_contact(model, data, name, site, item, gel)
            require_stable_step(model, data, name, site, item, gel)
            indenter = Indenter(geometry=item.geometry, friction=item.friction)
            scenes.append(Scene(name=name, preset=preset, body=None, indenter=indenter, gel=gel))
        return scenes, float(model.opt.timestep)

    def _join(self, scenes: list[Scene], step: float, substeps: int | None, sensor: SensorModel | None) -> None:
        self._use(TactilePads(scenes, step, substeps, sensor=sensor), 0)

    def _use(self, pads: TactilePads, first: int) -> None:
        self.pads, self._first = pads, first
        self._was_held = [False] * len(self.sites)

    # ------------------------------------------------------------------- step

    def step(self) -> None:
        """One step of MuJoCo's time with the gels, in place of `mj_step`. Raises what `GelPads.step` raises."""
        step_together([self])

    def begin_step(self) -> FloatArray:
        """MuJoCo's part of a step that depends on places and velocities. Returns the objects' poses in the frames of
        the pads (n, 7).

        Raises ValueError if the model's timestep has changed, SimulationDiverged if MuJoCo's state was not finite.
        """
        if float(self.model.opt.timestep) != self.pads.step_time:
            raise ValueError(
                f"timestep is {self.model.opt.timestep:g} s and was {self.pads.step_time:g} s when the sensor was made:"
                f" make a new TouchSensor"
            )
        load_mujoco().mj_step1(self.model, self.data)
        self._require_finite()
        return self.poses()

    def _require_finite(self) -> None:
        """Raises SimulationDiverged where MuJoCo has found a state that is not finite, after which it starts again."""
        kinds = load_mujoco().mjtWarning
        whats = {
            "position": kinds.mjWARN_BADQPOS, "velocity": kinds.mjWARN_BADQVEL, "acceleration": kinds.mjWARN_BADQACC
        }  # fmt: skip
        for what, kind in whats.items():
            if self.data.warning[kind].number:
                raise SimulationDiverged(
                    f"MuJoCo found the {what} not finite or huge at degree of freedom "
                    f"{self.data.warning[kind].lastinfo}, and has reset its data",
                    LaunchSpan("in the step before"),
                    "take shorter timesteps, look for missing masses and stiff servos, then reset data and sensor",
                    retry=False,
                )

    def end_step(self, responses: Sequence[Response | None]) -> None:
        """The rest of the step, with the responses (n,) of the pads, see `GelPads.responses`."""
        touching = {i: response for i, response in enumerate(responses) if response is not None}
        for i in touching:
            self._was_held[i] = True
        if not touching:
            load_mujoco().mj_step2(self.model, self.data)
            return
        jacobian = np.concatenate([self._jacobian(i) for i in touching])
        step_with_wrenches(self.model, self.data, jacobian, list(touching.values()))

    def poses(self) -> FloatArray:
        """(n, 7) position [m] and quaternion (x, y, z, w) of each pad's object in the pad's frame, as MuJoCo has
        computed its frames last."""
        found = np.empty((len(self.sites), 7))
        turned = np.empty(4)
        for i, (site, item) in enumerate(zip(self._sites, self._objects, strict=True)):
            axes = self.data.site_xmat[site].reshape(3, 3)
            place, turn = item.pose(self.data)
            found[i, :3] = axes.T @ (place - self.data.site_xpos[site])
            load_mujoco().mju_mat2Quat(turned, np.ascontiguousarray(axes.T @ turn).ravel())
            found[i, 3:] = turned[[1, 2, 3, 0]]
        return found

    def _jacobian(self, index: int) -> FloatArray:
        """(6, nv) of the motion of a pad's object relative to the pad: of its point at the pad's origin, and its turn,
        in the pad's axes."""
        site, nv = self._sites[index], self.model.nv
        ours, theirs = np.zeros((2, 3, nv)), np.zeros((2, 3, nv))
        mujoco = load_mujoco()
        mujoco.mj_jacSite(self.model, self.data, ours[0], ours[1], site)
        place = self.data.site_xpos[site].copy()
        mujoco.mj_jac(self.model, self.data, theirs[0], theirs[1], place, self._objects[index].body)
        back = self.data.site_xmat[site].reshape(3, 3).T
        return np.asarray((back @ (theirs - ours)).reshape(6, nv))

    # ---------------------------------------------------------------- results

    def _index(self, site: str) -> int:
        if site not in self.sites:
            raise KeyError(f"no pad '{site}'; this sensor has {', '.join(self.sites)}")
        return self._first + self.sites.index(site)

    @property
    def wrenches(self) -> FloatArray:
        """(n, 6) force and moment of the object on each pad, about its site, in the site's axes [N, N m]."""
        return self.pads.wrenches[self._first : self._first + len(self.sites)]

    @property
    def world_forces(self) -> FloatArray:
        """(n, 3) force of the object on each pad, world axes [N]."""
        axes = self.data.site_xmat[self._sites].reshape(-1, 3, 3)
        return np.asarray(np.einsum("nij,nj->ni", axes, self.wrenches[:, :3]))

    def surface(self, site: str) -> GelSurface:
        """The deformed surface of a pad's gel."""
        return self.pads.surface(self._index(site))

    def picture(self, site: str) -> Image:
        """(H, W, 3) uint8 RGB of a pad's camera. Raises ValueError if the sensor was made without one."""
        return self.pads.picture(self._index(site))

    def slip_share(self, site: str) -> float:
        """Share of the limit of friction that a pad uses, see `GelPads.slip_share` [-]."""
        return self.pads.slip_share(self._index(site))

    def require_held(self) -> None:
        """Raises ObjectDropped for an object that a pad has touched and that none touches now."""
        touching: NDArray[np.bool_] = (self.wrenches != 0.0).any(axis=1)
        for item in dict.fromkeys(self._objects):
            own = [i for i, other in enumerate(self._objects) if other is item]
            if any(self._was_held[i] for i in own) and not touching[own].any():
                self._report_dropped(item, [self.sites[i] for i in own])

    def _report_dropped(self, item: MujocoObject, sites: Sequence[str]) -> NoReturn:
        height = float(self.data.geom_xpos[item.geom, 2])
        mass = float(self.model.body_subtreemass[self.model.body_weldid[item.body]])
        raise ObjectDropped(
            f"object '{item.name}' was dropped: at {self.data.time:.4g} s none of its pads {', '.join(sites)} touches "
            f"it, and it is at z = {height:.4g} m. Two pads hold {mass:.3g} kg still with at least "
            f"{mass * float(np.linalg.norm(self.model.opt.gravity)) / (2 * max(item.friction, 1e-9)):.3g} N each"
        )

    # ------------------------------------------------------------------ state

    def reset(self) -> None:
        """Makes the gels as new: to be called after MuJoCo's state was reset, with the objects clear of the pads."""
        for i in range(len(self.sites)):
            self.pads.reset(self._first + i)
        self._was_held = [False] * len(self.sites)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """A copy of the whole state, gels and MuJoCo's, as named arrays."""
        mujoco = load_mujoco()
        spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        numbers = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, numbers, spec)
        state: dict[str, NDArray[Any]] = {"mujoco": numbers, "held": np.array(self._was_held)}
        for i, site in enumerate(self.sites):
            state |= {f"{site}/{name}": value for name, value in self.pads.snapshot(self._first + i).items()}
        return state

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Raises ValueError if `state` is no snapshot of such a sensor."""
        mujoco = load_mujoco()
        spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        numbers = np.asarray(state.get("mujoco", ()), np.float64)
        if numbers.shape != (mujoco.mj_stateSize(self.model, spec),):
            raise ValueError("snapshot: 'mujoco' does not fit this model; is it of another scene?")
        for i, site in enumerate(self.sites):
            own = {name.removeprefix(f"{site}/"): v for name, v in state.items() if name.startswith(f"{site}/")}
            self.pads.restore(self._first + i, own)
        self._was_held = [bool(held) for held in state["held"]]
        mujoco.mj_setState(self.model, self.data, numbers, spec)
        mujoco.mj_forward(self.model, self.data)


def step_together(sensors: Sequence[TouchSensor]) -> None:
    """One step of all sensors of a batch, their gels in one launch. Raises what `GelPads.step` raises; MuJoCo's states
    have then not moved."""
    pads = sensors[0].pads
    count = sum(len(each.sites) for each in sensors)
    if any(each.pads is not pads for each in sensors) or count != len(pads):
        raise ValueError("step_together needs all sensors of one batch (TouchSensor.batch)")
    poses = np.concatenate([each.begin_step() for each in sensors])
    pads.step(poses)
    responses, first = pads.responses(), 0
    for each in sensors:
        each.end_step(responses[first : first + len(each.sites)])
        first += len(each.sites)
