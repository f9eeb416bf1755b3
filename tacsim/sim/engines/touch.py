"""Tactile sensors in a MuJoCo scene: gel pads at its sites, which hold, drag and let go of its objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from tacsim.control import ObjectDropped as ObjectDropped
from tacsim.interface import FloatArray, Image
from tacsim.models.scene import Gel, GelSurface, Indenter, Preset, Scene, Shape
from tacsim.models.sensor import SensorModel
from tacsim.physics.failure.health import LaunchSpan, SimulationDiverged
from tacsim.physics.pads.launch import StepError
from tacsim.sim.engines.implicit_step import Responses, step_with_wrenches
from tacsim.sim.engines.mujoco_module import load_mujoco
from tacsim.sim.engines.mujoco_objects import (
    MujocoObject,
    find_object,
    find_site,
    require_no_contact,
    require_stable_step,
)
from tacsim.sim.pads import PadPlace, TactilePads


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
        scenes, step = self._describe(model, data, sites, objects, gel or Gel(), friction, geometry or {}, preset)
        self._use(TactilePads(scenes, step, substeps, sensor=sensor), 0)

    @classmethod
    def in_place(
        cls, place: PadPlace, model: Any, data: Any, sites: Sequence[str], objects: str | Sequence[str], *,
        gel: Gel | None = None, friction: float | None = None, geometry: Mapping[str, Shape] | None = None,
        preset: Preset = "learn",
    ) -> Self:  # fmt: skip
        """A sensor whose pads have a place among those of other simulations, see :meth:`batch`."""
        made = cls.__new__(cls)
        described = made._describe(model, data, sites, objects, gel or Gel(), friction, geometry or {}, preset)
        made._use(*place.fill(*described))
        return made

    @classmethod
    def batch(
        cls, scenes: Sequence[tuple[Any, Any]], sites: Sequence[str], objects: str | Sequence[str], *,
        gel: Gel | None = None, friction: float | None = None, geometry: Mapping[str, Shape] | None = None,
        preset: Preset = "learn", substeps: int | None = None, sensor: SensorModel | None = None,
    ) -> list[Self]:  # fmt: skip
        """Sensors in several scenes, whose gels `step_each` and `step_together` advance in one launch; each has the
        bits that it has alone.

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
        self._geoms = [item.geom for item in self._objects]
        self._places = np.array([item.place for item in self._objects])[..., None]  # (n, 3, 1)
        self._turns = np.array([item.turn for item in self._objects])
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

    def _use(self, pads: TactilePads, first: int) -> None:
        self.pads, self._numbers = pads, range(first, first + len(self.sites))
        self._was_held = [False] * len(self.sites)
        for number, site in zip(self._numbers, self.sites, strict=True):
            pads.names[number] = f"pad '{site}'"

    # ------------------------------------------------------------------- step

    def step(self) -> None:
        """One step of MuJoCo's time with the gels, in place of `mj_step`. Raises what `GelPads.step` raises, and
        SimulationDiverged if MuJoCo's state was not finite; nothing has then moved."""
        (failure,) = step_each([self])
        if failure is not None:
            raise failure

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
        numbers = self.data.warning.number
        for what, kind in _state_warnings().items():
            if numbers[kind]:
                raise SimulationDiverged(
                    f"MuJoCo found the {what} not finite or huge at degree of freedom "
                    f"{self.data.warning[kind].lastinfo}, and has reset its data",
                    LaunchSpan("in the step before"),
                    "take shorter timesteps, look for missing masses and stiff servos, then reset data and sensor",
                    retry=False,
                )

    def end_step(self, touching: NDArray[np.intp], responses: Responses) -> None:
        """The rest of the step. touching: numbers of own pads, among those of the batch, that touch their objects;
        responses: of these, see `GelPads.responses`."""
        if not len(touching):
            load_mujoco().mj_step2(self.model, self.data)
            return
        own = (touching - self._numbers.start).tolist()
        for i in own:
            self._was_held[i] = True
        step_with_wrenches(self.model, self.data, self._jacobian(own), responses)

    def poses(self) -> FloatArray:
        """(n, 7) position [m] and quaternion (x, y, z, w) of each pad's object in the pad's frame, as MuJoCo has
        computed its frames last."""
        data, mujoco = self.data, load_mujoco()
        found, turned = np.empty((len(self.sites), 7)), np.empty(4)
        axes = data.site_xmat[self._sites].reshape(-1, 3, 3)
        theirs = data.geom_xmat[self._geoms].reshape(-1, 3, 3)
        places = data.geom_xpos[self._geoms] + (theirs @ self._places)[..., 0] - data.site_xpos[self._sites]
        found[:, :3] = (places[:, None] @ axes)[:, 0]
        for i, turn in enumerate((axes.transpose(0, 2, 1) @ (theirs @ self._turns)).reshape(-1, 9)):
            mujoco.mju_mat2Quat(turned, turn)
            found[i, 3:6], found[i, 6] = turned[1:], turned[0]
        return found

    def _jacobian(self, pads: Sequence[int]) -> FloatArray:
        """(6 k, nv) of the motions of objects relative to some pads: of the point at the pad's origin, and the turn, in
        the pad's axes."""
        mujoco, model, data = load_mujoco(), self.model, self.data
        both = np.zeros((2, len(pads), 2, 3, model.nv))
        for ours, theirs, i in zip(*both, pads, strict=True):
            site = self._sites[i]
            mujoco.mj_jacSite(model, data, ours[0], ours[1], site)
            mujoco.mj_jac(model, data, theirs[0], theirs[1], data.site_xpos[site], self._objects[i].body)
        back = data.site_xmat[[self._sites[i] for i in pads]].reshape(-1, 1, 3, 3).transpose(0, 1, 3, 2)
        return np.asarray((back @ (both[1] - both[0])).reshape(-1, model.nv))

    # ---------------------------------------------------------------- results

    @property
    def numbers(self) -> range:
        """Of its pads among those of the batch."""
        return self._numbers

    def _index(self, site: str) -> int:
        if site not in self.sites:
            raise KeyError(f"no pad '{site}'; this sensor has {', '.join(self.sites)}")
        return self._numbers[self.sites.index(site)]

    @property
    def wrenches(self) -> FloatArray:
        """(n, 6) force and moment of the object on each pad, about its site, in the site's axes [N, N m]."""
        return self.pads.wrenches_of(self._numbers)

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
        for number in self._numbers:
            self.pads.reset(number)
        self._was_held = [False] * len(self.sites)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """A copy of the whole state, gels and MuJoCo's, as named arrays."""
        mujoco = load_mujoco()
        spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        numbers = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, numbers, spec)
        state: dict[str, NDArray[Any]] = {"mujoco": numbers, "held": np.array(self._was_held)}
        for number, site in zip(self._numbers, self.sites, strict=True):
            state |= {f"{site}/{name}": value for name, value in self.pads.snapshot(number).items()}
        return state

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Raises ValueError if `state` is no snapshot of such a sensor."""
        mujoco = load_mujoco()
        spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        numbers = np.asarray(state.get("mujoco", ()), np.float64)
        if numbers.shape != (mujoco.mj_stateSize(self.model, spec),):
            raise ValueError("snapshot: 'mujoco' does not fit this model; is it of another scene?")
        for number, site in zip(self._numbers, self.sites, strict=True):
            own = {name.removeprefix(f"{site}/"): v for name, v in state.items() if name.startswith(f"{site}/")}
            self.pads.restore(number, own)
        self._was_held = [bool(held) for held in state["held"]]
        mujoco.mj_setState(self.model, self.data, numbers, spec)
        mujoco.mj_forward(self.model, self.data)


def step_together(sensors: Sequence[TouchSensor]) -> None:
    """One step of all sensors of a batch, their gels in one launch. Raises what `GelPads.step` raises; nothing has then
    moved, in none of them."""
    pads = sensors[0].pads
    count = sum(len(each.sites) for each in sensors)
    if any(each.pads is not pads for each in sensors) or count != len(pads):
        raise ValueError("step_together needs all sensors of one batch (TouchSensor.batch)")
    pads.step(np.concatenate([each.begin_step() for each in sensors]))
    _end_steps(sensors)


def step_each(sensors: Sequence[TouchSensor]) -> list[StepError | None]:
    """One step of some sensors of a batch, their gels in one launch; those that are not given stay as they are.

    sensors: in the order of the batch. Returns of each the error that `TouchSensor.step` would raise: its scene has
    then not moved, and the others are not affected. Raises ValueError for sensors of several batches, and if the
    timestep of a model has changed.
    """
    if any(each.pads is not sensors[0].pads for each in sensors):
        raise ValueError("step_each needs sensors of one batch (TouchSensor.batch)")
    failures: list[StepError | None] = [None] * len(sensors)
    poses: dict[int, FloatArray] = {}
    for number, each in enumerate(sensors):
        try:
            poses[number] = each.begin_step()
        except SimulationDiverged as failure:
            failures[number] = failure
    if poses:
        begun = [sensors[number] for number in poses]
        ends = begun[0].pads.step_scenes([each.numbers for each in begun], np.concatenate(list(poses.values())))
        for number, end in zip(poses, ends, strict=True):
            failures[number] = end
    _end_steps([each for each, failure in zip(sensors, failures, strict=True) if failure is None])
    return failures


def _end_steps(sensors: Sequence[TouchSensor]) -> None:
    if not sensors:
        return
    touching, responses = sensors[0].pads.responses([number for each in sensors for number in each.numbers])
    for each in sensors:
        first, end = np.searchsorted(touching, [each.numbers.start, each.numbers.stop]).tolist()
        each.end_step(touching[first:end], responses.of(slice(first, end)))


@cache
def _state_warnings() -> dict[str, int]:
    """MuJoCo's warnings of what is not finite, by name."""
    kinds = load_mujoco().mjtWarning
    return {
        "position": int(kinds.mjWARN_BADQPOS), "velocity": int(kinds.mjWARN_BADQVEL),
        "acceleration": int(kinds.mjWARN_BADQACC),
    }  # fmt: skip
