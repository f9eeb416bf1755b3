"""The entities of an episode in Rerun, and their layout on the screen.

| entity                              | what                                                                   |
|-------------------------------------|------------------------------------------------------------------------|
| `/world/{sensor}/gel`               | surface at the sensor's pose, coloured by height                       |
| `/world/{sensor}/flow`              | displacement of its markers                                            |
| `/world/{arm}`                      | pose of the sensor that the arm carries                                |
| `/world/{arm}/force`                | force of the object on it, 1 mm per newton                             |
| `/world/body`                       | particles of the plasticine; live, or if they were recorded            |
| `/world/asked/{arm}`                | target of the arm                                                      |
| `/camera/{sensor}`                  | the camera image                                                       |
| `/canonical/{sensor}`               | the canonical picture, input of a policy                               |
| `/force`, `/torque`, `/joints`      | numbers of the arms [N, N m, rad]                                      |
| `/task/reward`, `/task/distance`    | of the step [-, mm]                                                    |
| `/limits/{arm}`                     | targets shortened or refused so far                                    |
| `/status/{arm}`                     | the driver's status, in words, when it changed                         |
| `/diagnostics/{name}`               | all other numbers of the step                                          |

Time lines: `time` [s] since reset, on the rig's clock, and `step`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot.arm.status import ArmStatus
from tacsim.interface import ArmState, Observation, Pose, RigSpec, TactileObservation, Truth
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.grid import canonical_cells
from tacsim.record.episode import LIMITS_HIT, ArmPackages, Step
from tacsim.record.images import encode_png

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

AXES = {"x": (220, 60, 60), "y": (60, 180, 60), "z": (70, 110, 240)}
COLOURS = np.array([(70, 70, 90), (60, 120, 190), (90, 200, 130), (250, 230, 60)], np.float64)  # by depth
ARROW = 0.1e-3  # radius [m]
GEL_WIDTH = 20e-3  # about, for the distance of the camera [m]
PLOTS = {"force": "force [N]", "task": "reward, distance [mm]"}  # entity and name
MORE_PLOTS = {"limits": "limits hit", "diagnostics": "diagnostics"}


class EpisodeLog:
    """Writes the steps of an episode into a Rerun recording.

    lattices: rest positions of the markers (m, n, 2) by sensor, sensor frame [m]; without them no flow is drawn.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        spec: RigSpec,
        canonical: CanonicalGrid,
        lattices: Mapping[str, NDArray[np.float64]],
    ) -> None:
        self._recording, self._spec, self._lattices = recording, spec, lattices
        self._cells = canonical_cells(canonical).points()
        self._begin: float | None = None
        self._status: dict[str, int] = {}
        self._meshed: set[str] = set()

    def step(self, step: Step, observation: Observation, truth: Truth | None = None) -> None:
        """Logs all data of one step."""
        import rerun as rr

        if self._begin is None:
            self._begin = step.time
            self._recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._set_time(step.time)
        self._recording.set_time("step", sequence=step.index)
        for name, state in observation.arms.items():
            self._log_arm(name, state)
        for name, touch in observation.tactile.items():
            self._log_sensor(name, touch, observation.arms)
            self._log_picture(f"camera/{name}", step.frames[name].image)
        for name, target in ({} if step.action is None else step.action.tool).items():
            if target is not None:
                self._log_point(f"world/asked/{name}", target)
        particles = step.body if truth is None else truth.points
        if particles is not None:
            grains = rr.Points3D(particles, radii=[ARROW / 2], colors=[(200, 150, 110)])
            self._recording.log("world/body", grains)
        self._log_numbers(step)
        for name, packages in step.packages.items():
            self._log_statuses(name, packages)

    def _set_time(self, time: float) -> None:
        assert self._begin is not None
        self._recording.set_time("time", duration=time - self._begin)

    def _log_arm(self, name: str, state: ArmState) -> None:
        metres_per_newton = 1e-3  # length of an arrow [m/N]
        import rerun as rr

        self._log_pose(f"world/{name}", state.pose)
        force = [metres_per_newton * state.wrench[:3]]
        arrow = rr.Arrows3D(vectors=force, origins=[(0, 0, 0)], radii=[3 * ARROW], colors=[(250, 140, 30)])
        self._recording.log(f"world/{name}/force", arrow)
        for kind, values in (("force", state.wrench[:3]), ("torque", state.wrench[3:])):
            for axis, value in zip(AXES, values, strict=True):
                self._log_number(f"{kind}/{name}/{axis}", float(value))
        for joint, angle in enumerate(() if state.joints is None else state.joints):
            self._log_number(f"joints/{name}/joint_{joint + 1}", float(angle))

    def _log_sensor(self, name: str, touch: TactileObservation, arms: Mapping[str, ArmState]) -> None:
        import rerun as rr

        self._log_picture(f"canonical/{name}", touch.image)
        carrier = self._spec.sensors[name].arm
        if carrier is not None and carrier != name and carrier in arms:
            self._log_pose(f"world/{name}", arms[carrier].pose)
        if touch.height is None:
            return
        if name not in self._meshed:
            triangles = rr.Mesh3D.from_fields(triangle_indices=_triangles(touch.valid))
            self._recording.log(f"world/{name}/gel", triangles, static=True)
            self._meshed.add(name)
        height = touch.height[touch.valid].astype(np.float64)
        points = np.column_stack([self._cells[touch.valid], -height])  # z is out of the gel
        mesh = rr.Mesh3D.from_fields(vertex_positions=points.astype(np.float32), vertex_colors=_colours(height))
        self._recording.log(f"world/{name}/gel", mesh)
        lattice = self._lattices.get(name)
        if touch.flow is not None and lattice is not None and lattice.shape == touch.flow.shape:
            vectors = np.dstack([touch.flow, np.zeros(touch.flow.shape[:2])]).reshape(-1, 3)
            origins = np.dstack([lattice, np.full(lattice.shape[:2], ARROW)]).reshape(-1, 3)
            arrows = rr.Arrows3D(vectors=vectors, origins=origins, radii=[ARROW / 2], colors=[(240, 240, 240)])
            self._recording.log(f"world/{name}/flow", arrows)

    def _log_numbers(self, step: Step) -> None:
        if step.reward is not None:
            self._log_number("task/reward", step.reward)
        if step.distance is not None:
            self._log_number("task/distance", 1e3 * step.distance)
        self._log_number("diagnostics/seconds", step.seconds)
        for name, value in step.info.items():
            limit = name.removeprefix(LIMITS_HIT)
            self._log_number(f"diagnostics/{name}" if limit == name else f"limits/{limit}", value)

    def _log_statuses(self, name: str, packages: ArmPackages) -> None:
        """Logs each change of the status at its own time."""
        import rerun as rr

        for time, status in zip(packages.time.tolist(), packages.status.tolist(), strict=True):
            if self._status.get(name) != status:
                self._status[name] = status
                self._set_time(time)
                words = ArmStatus(status).name if status in set(ArmStatus) else f"status {status}"
                fine = status < ArmStatus.FORCE_LIMIT
                level = rr.TextLogLevel.INFO if fine else rr.TextLogLevel.ERROR
                self._recording.log(f"status/{name}", rr.TextLog(words, level=level))

    def _log_pose(self, entity: str, pose: Pose) -> None:
        import rerun as rr

        turn = rr.Quaternion(xyzw=pose.quaternion)
        self._recording.log(entity, rr.Transform3D(translation=pose.position, quaternion=turn))

    def _log_point(self, entity: str, pose: Pose) -> None:
        import rerun as rr

        self._recording.log(entity, rr.Points3D([pose.position], radii=[5 * ARROW], colors=[(250, 80, 200)]))

    def _log_picture(self, entity: str, image: NDArray[np.uint8]) -> None:
        import rerun as rr

        self._recording.log(entity, rr.EncodedImage(contents=encode_png(image), media_type="image/png"))

    def _log_number(self, entity: str, value: float) -> None:
        import rerun as rr

        self._recording.log(entity, rr.Scalars([value]))


def blueprint(spec: RigSpec, arms: Mapping[str, ArmState]) -> rrb.Blueprint:
    """Two tabs: the episode (gels in space, camera pictures, force and reward), and the diagnostics.

    arms: those of the first step, at which the camera of the view in space looks.
    """
    import rerun.blueprint as rrb

    space = rrb.Spatial3DView(origin="/world", name="gels", **_camera_option(arms))
    cameras = [rrb.Spatial2DView(origin=f"/camera/{name}", name=name) for name in spec.sensors]
    canonical = [rrb.Spatial2DView(origin=f"/canonical/{name}", name=f"canonical {name}") for name in spec.sensors]
    plots = [rrb.TimeSeriesView(origin=f"/{origin}", name=name) for origin, name in PLOTS.items()]
    more = [rrb.TimeSeriesView(origin=f"/{origin}", name=name) for origin, name in MORE_PLOTS.items()]
    episode = rrb.Horizontal(
        space, rrb.Vertical(rrb.Horizontal(*cameras), *plots), column_shares=[3, 2], name="episode"
    )
    diagnostics = rrb.Vertical(
        rrb.Horizontal(*canonical), rrb.Horizontal(*more, rrb.TextLogView(origin="/status", name="status")),
        name="diagnostics",
    )  # fmt: skip
    return rrb.Blueprint(
        rrb.Tabs(episode, diagnostics, active_tab=0), rrb.TimePanel(state="collapsed"), collapse_panels=True
    )


def _camera_option(arms: Mapping[str, ArmState]) -> dict[str, Any]:
    """The option of a view in space that puts its camera in front of the gels; Rerun before 0.27 has none."""
    import rerun.blueprint as rrb

    if not hasattr(rrb, "EyeControls3D"):
        return {}
    positions = np.array([state.pose.position for state in arms.values()]) if arms else np.zeros((1, 3))
    middle = positions.mean(axis=0)
    distance = 2.5 * max(GEL_WIDTH, float(np.ptp(positions, axis=0).max()))
    eye = middle + distance * np.array([-0.45, -0.8, 0.4])
    return {"eye_controls": rrb.EyeControls3D(position=eye, look_target=middle, eye_up=(0, 0, 1))}


def _triangles(valid: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """(k, 3) numbers of the valid cells, counted along rows: two for each four neighbours that are all valid."""
    number = np.cumsum(valid.ravel()).reshape(valid.shape) - 1
    whole = valid[:-1, :-1] & valid[1:, :-1] & valid[:-1, 1:] & valid[1:, 1:]
    a, b, c, d = (part[whole] for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)]).astype(np.uint32)


def _colours(height: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(n, 3) colours by depth, from 0 to `max_depth`."""
    max_depth = 1e-3  # drawn in the last colour [m]
    share = np.clip(height / max_depth, 0.0, 1.0) * (len(COLOURS) - 1)
    channels = [np.interp(share, np.arange(len(COLOURS)), COLOURS[:, channel]) for channel in range(3)]
    found: NDArray[np.uint8] = np.stack(channels, axis=1).astype(np.uint8)
    return found
