"""Dumps of diverged motions: data to inspect a motion and to run it again (`tacsim debug`).

A dump is a folder: `dump.json` (scene, poses, command, message, versions) and `state.npz`, whose arrays are named
`before.*` (before the motion), `good.*` and `failed.*` (at the start and end of the launch that failed). The mesh file
of a body or indenter is copied into it. Nothing in a dump is executed.
"""

from __future__ import annotations

import os
import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from tacsim.interface import Pose
from tacsim.models.quantity import Config
from tacsim.models.scene import Mesh, Scene
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.failure.tuning import MAX_DUMPS
from tacsim.physics.move import MoveCommand
from tacsim.physics.snapshot import State

FOLDER = "TACSIM_DUMPS"  # environment variable: where dumps are written; without it, or if it is empty, none are
MOMENTS = ("before", "good", "failed")
MESH = "shape"  # and the suffix of the file it is a copy of

PoseNumbers = tuple[float, float, float, float, float, float, float]  # position [m], unit quaternion (x, y, z, w)
Poses = Mapping[str, Pose]


class DumpError(ValueError):
    """A folder without a dump, or with a damaged one."""


class DumpInfo(Config):
    """`dump.json`."""

    format: Literal["tacsim dump 2"] = "tacsim dump 2"
    message: str  # of the error: cause, place, part of the motion, advice
    scene: Scene
    poses: dict[str, PoseNumbers]  # before the motion
    targets: dict[str, PoseNumbers]
    loads: dict[str, float]  # [N]
    duration: float | None  # [s]
    flow: bool
    failed_poses: dict[str, PoseNumbers]  # at the end of the launch that failed; empty if there was none
    health: dict[str, str]  # what the kernels reported of that launch
    versions: dict[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Dump:
    """A dump as read: `dump.json`, and its arrays by moment ("before", "good", "failed"; the last two may be empty)."""

    info: DumpInfo
    states: Mapping[str, State]

    @property
    def command(self) -> MoveCommand:
        """The motion."""
        info = self.info
        return MoveCommand(_poses_of_numbers(info.targets), info.loads, info.duration, info.flow)

    def poses(self, moment: str) -> dict[str, Pose]:
        """Of the driven frames; at "good" those of the end of its launch, a few substeps later."""
        return _poses_of_numbers(self.info.poses if moment == "before" else self.info.failed_poses or self.info.poses)


@contextmanager
def dump_to_folder(folder: Path | None) -> Iterator[None]:
    """Context in which diverged motions are dumped below `folder`, or below the folder in TACSIM_DUMPS if it is set, in
    this process and in those that it starts. None: no dumps."""
    given = os.environ.get(FOLDER)
    os.environ[FOLDER] = "" if folder is None else given or str(folder)
    try:
        yield
    finally:
        del os.environ[FOLDER]
        if given is not None:
            os.environ[FOLDER] = given


def write_dump(scene: Scene, poses: Poses, command: MoveCommand, before: State, failure: SimulationDiverged) -> None:
    """Writes a dump into a new folder below the one in TACSIM_DUMPS, if it is set, and records the folder in `failure`.

    poses: of the driven frames before the motion; before: the state then. If the dump cannot be written, its folder is
    removed and `failure` states the reason.
    """
    parent = os.environ.get(FOLDER)
    if parent is None:
        failure.no_dump = f"set {FOLDER} to a folder to keep a replayable state"
    if not parent:
        return
    try:
        folder = _new_folder(Path(parent))
        try:
            _write_files(folder, scene, poses, command, before, failure)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        failure.dump = folder
    except (OSError, ValueError) as error:
        failure.no_dump = f"no dump could be written to {parent}: {error}"


def _new_folder(parent: Path) -> Path:
    """A new folder 00 ... 19 below `parent`; several processes may do this at once."""
    parent.mkdir(parents=True, exist_ok=True)
    for number in range(MAX_DUMPS):
        try:
            (parent / f"{number:02d}").mkdir()
        except FileExistsError:
            continue
        return parent / f"{number:02d}"
    raise DumpError(f"it holds {MAX_DUMPS} dumps, which is the limit; remove some")


def _write_files(
    folder: Path, scene: Scene, poses: Poses, command: MoveCommand, before: State, failure: SimulationDiverged
) -> None:
    if (mesh := _find_mesh(scene)) is not None:
        name = f"{MESH}{Path(mesh).suffix.lower()}"
        shutil.copyfile(mesh, folder / name)
        scene = _with_mesh(scene, Path(name))
    arrays = {
        f"{moment}.{name}": np.asarray(a, order="C")  # copies of particles have the kernels' memory layout
        for moment, state in zip(MOMENTS, (before, failure.good, failure.failed), strict=True)
        for name, a in state.items()
    }
    np.savez_compressed(folder / "state.npz", **arrays)  # type: ignore[arg-type]  # mypy takes a name for allow_pickle
    info = DumpInfo(
        message=str(failure),
        scene=scene,
        poses=_pose_numbers(poses),
        targets=_pose_numbers(command.targets),
        loads=dict(command.loads),
        duration=command.duration,
        flow=command.flow,
        failed_poses=_pose_numbers(failure.poses),
        health={} if failure.health is None else {k: f"{v:.9g}" for k, v in asdict(failure.health).items()},
        versions={d.name: d.version for d in metadata.distributions() if d.name in ("tacsim", "numpy", "taichi")},
    )
    # last: then the dump is complete
    (folder / "dump.json").write_text(info.model_dump_json(indent=1) + "\n", encoding="utf-8")


def _pose_numbers(poses: Poses) -> dict[str, PoseNumbers]:
    return {name: (*pose.position.tolist(), *pose.quaternion.tolist()) for name, pose in poses.items()}


def _poses_of_numbers(numbers: Mapping[str, PoseNumbers]) -> dict[str, Pose]:
    return {name: Pose(np.array(v[:3]), np.array(v[3:])) for name, v in numbers.items()}


def _find_mesh(scene: Scene) -> str | None:
    """The path of the mesh file of the scene's body or indenter; None if neither has one."""
    owner = scene.body if scene.indenter is None else scene.indenter
    return owner.geometry.path if owner is not None and isinstance(owner.geometry, Mesh) else None


def _with_mesh(scene: Scene, path: Path) -> Scene:
    """A scene that has a mesh file, with that file's path changed to `path`."""
    part = "body" if scene.indenter is None else "indenter"
    owner = getattr(scene, part)
    geometry = owner.geometry.model_copy(update={"path": str(path)})
    return scene.model_copy(update={part: owner.model_copy(update={"geometry": geometry})})


def read_dump(folder: Path) -> Dump:
    """Reads the dump in `folder` (or the folder of the dump.json named). Raises DumpError, FileNotFoundError."""
    folder = folder.parent if folder.name == "dump.json" else folder
    described, arrays = folder / "dump.json", folder / "state.npz"
    if not described.is_file():
        raise FileNotFoundError(f"{folder} is no dump: it has no dump.json; name a folder such as OUT/diverged/00")
    try:
        info = DumpInfo.model_validate_json(described.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "the file"
        raise DumpError(f"{described}: {key}: {first['msg']}; was it written by this version?") from None
    states: dict[str, dict[str, NDArray[Any]]] = {moment: {} for moment in MOMENTS}
    try:
        with arrays.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            for key in archive.files:
                moment, _, name = key.partition(".")
                states[moment][name] = archive[key]
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DumpError(f"{arrays} is missing or damaged: {error}") from None
    if _find_mesh(info.scene) is not None:  # whatever path it has: a dump names no file but its own
        name = next(iter(sorted(folder.glob(f"{MESH}.*"))), folder / MESH)
        info = info.model_copy(update={"scene": _with_mesh(info.scene, name)})
    return Dump(info, states)
