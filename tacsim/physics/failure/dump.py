"""Dumps of diverged motions: what is needed to look into one, and to run it again.

A dump is a folder: `dump.json` (scene, poses, targets, loads, cause, versions) and `state.npz`, whose arrays are named
`before.*` (before the motion), `good.*` and `failed.*` (at the start and end of the launch that went wrong). A body or
indenter from an STL file brings that file along. Nothing in a dump is executed; what is read is checked for its size.
"""

from __future__ import annotations

import os
import platform
import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from tacsim.interface import Pose
from tacsim.models.quantity import Config
from tacsim.models.scene import Mesh, Scene, Shape
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.move import MoveCommand
from tacsim.physics.snapshot import State

FOLDER = "TACSIM_DUMPS"  # environment variable: where dumps are written; none are without it, or where it is empty
MOST_DUMPS = 20  # in one folder; training that diverges again and again must not fill the disk
MOST_JSON = 1_000_000  # bytes
MOST_ARRAYS = 100
MOST_BYTES = 2_000_000_000  # of all arrays together
MOST_SECONDS = 1000.0  # of a dynamic motion; a tenth of a second takes as many substeps as a dozen squeezes
DTYPES = {"float32", "float64", "int32", "int64", "bool"}
MOMENTS = ("before", "good", "failed")
MESH = "shape.stl"

Numbers7 = tuple[float, float, float, float, float, float, float]
Poses = Mapping[str, Pose]


class DumpError(ValueError):
    """A folder that is no sound dump."""


class DumpInfo(Config):
    """`dump.json`. Poses: position [m], then the unit quaternion (x, y, z, w)."""

    format: Literal["tacsim dump 1"] = "tacsim dump 1"
    time: str  # UTC
    cause: str
    place: str
    where: str
    advice: str
    refine: int = Field(ge=1)  # the step of the last attempt was the nominal one over this
    scene: Scene
    poses: dict[str, Numbers7]  # before the motion
    targets: dict[str, Numbers7]  # asked for
    loads: dict[str, float] = {}  # held by sensors [N]; dumps of older versions say nothing of them
    duration: float | None = Field(None, gt=0, le=MOST_SECONDS)  # of a dynamic motion [s]
    flow: bool = False  # it flows into the next
    failed_poses: dict[str, Numbers7]  # at the end of the launch that went wrong; empty if there was none
    health: dict[str, str]  # what the kernels saw in the last launch
    versions: dict[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Dump:
    """A dump as read: its facts, and its arrays by moment ("before", "good", "failed"; the last two may be empty)."""

    info: DumpInfo
    states: Mapping[str, State]

    @property
    def order(self) -> MoveCommand:
        """What the motion was asked for."""
        info = self.info
        return MoveCommand(_poses(info.targets), info.loads, info.duration, info.flow)

    def poses(self, moment: str) -> dict[str, Pose]:
        """Of the driven frames; at "good" those of the end of its launch, a few substeps later."""
        return _poses(self.info.poses if moment == "before" else self.info.failed_poses or self.info.poses)


def _poses(numbers: Mapping[str, Numbers7]) -> dict[str, Pose]:
    return {name: Pose(np.array(v[:3]), np.array(v[3:])) for name, v in numbers.items()}


@contextmanager
def dumps_in(folder: Path) -> Iterator[None]:
    """Diverged motions are dumped below `folder`, here and in processes started meanwhile; TACSIM_DUMPS goes first."""
    given = os.environ.get(FOLDER)
    os.environ[FOLDER] = given or str(folder)
    try:
        yield
    finally:
        if given is None:
            del os.environ[FOLDER]
        else:
            os.environ[FOLDER] = given


@contextmanager
def no_dumps() -> Iterator[None]:
    """No motion is dumped, whatever TACSIM_DUMPS says."""
    given = os.environ.get(FOLDER)
    os.environ[FOLDER] = ""
    try:
        yield
    finally:
        if given is None:
            del os.environ[FOLDER]
        else:
            os.environ[FOLDER] = given


def write(
    folder: Path,
    scene: Scene,
    poses: Poses,
    order: MoveCommand,
    before: State,
    failure: SimulationDiverged,
) -> Path:
    """Writes a dump into a new folder below `folder` and returns it.

    poses: of the driven frames before the motion; before: the state then. Raises OSError, DumpError when there are
    MOST_DUMPS already; nothing is left of a dump that could not be written whole.
    """
    place = _new(folder)
    try:
        _write(place, scene, poses, order, before, failure)
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)
        raise
    return place


def _write(
    place: Path, scene: Scene, poses: Poses, order: MoveCommand, before: State, failure: SimulationDiverged
) -> None:  # fmt: skip
    scene, mesh = _with_mesh(scene, MESH)
    if mesh is not None:
        shutil.copyfile(mesh, place / MESH)
    info = DumpInfo(
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        cause=failure.cause,
        place=failure.place,
        where=failure.where,
        advice=failure.advice,
        refine=failure.refine,
        scene=scene,
        poses={name: _numbers(pose) for name, pose in poses.items()},
        targets={name: _numbers(pose) for name, pose in order.targets.items()},
        loads=dict(order.loads),
        duration=order.duration,
        flow=order.flow,
        failed_poses={name: _numbers(pose) for name, pose in failure.poses.items()},
        health={} if failure.health is None else {k: f"{v:.9g}" for k, v in asdict(failure.health).items()},
        versions=_versions(),
    )
    arrays = {
        f"{moment}.{name}": np.asarray(a, order="C")  # copies of particles lie as the kernels have them
        for moment, state in zip(MOMENTS, (before, failure.good, failure.failed), strict=True)
        for name, a in state.items()
    }
    np.savez_compressed(place / "state.npz", **arrays)  # type: ignore[arg-type]  # mypy takes a name for allow_pickle
    (place / "dump.json").write_text(info.model_dump_json(indent=1) + "\n", encoding="utf-8")  # last: now it is whole


def _new(folder: Path) -> Path:
    """A new folder 00 ... 19 below `folder`; several processes may do this at once."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(MOST_DUMPS):
        try:
            (folder / f"{number:02d}").mkdir()
        except FileExistsError:
            continue
        return folder / f"{number:02d}"
    raise DumpError(f"it holds {MOST_DUMPS} dumps, which is the limit; remove some")


def _numbers(pose: Pose) -> Numbers7:
    x, y, z, *q = (float(v) for v in (*pose.position, *pose.quaternion))
    return (x, y, z, q[0], q[1], q[2], q[3])


def _with_mesh(scene: Scene, path: str) -> tuple[Scene, Path | None]:
    """The scene with the path of its STL file changed to `path`, and the path it had; None if it has no such file."""
    for part in ("body", "indenter"):
        owner = getattr(scene, part)
        if owner is not None and isinstance(owner.geometry, Mesh):
            geometry: Shape = owner.geometry.model_copy(update={"path": path})
            return scene.model_copy(update={part: owner.model_copy(update={"geometry": geometry})}), Path(
                owner.geometry.path
            )
    return scene, None


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": f"{platform.system()} {platform.machine()}"}
    for package in ("tacsim", "numpy", "taichi"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


# ------------------------------------------------------------------ reading


def read(folder: Path) -> Dump:
    """Reads the dump in `folder` (or the folder of the dump.json named). Raises DumpError, FileNotFoundError."""
    folder = folder.parent if folder.name == "dump.json" else folder
    described = folder / "dump.json"
    if not described.is_file():
        raise FileNotFoundError(f"{folder} is no dump: it has no dump.json; name a folder such as OUT/diverged/00")
    size = described.stat().st_size
    if size > MOST_JSON:
        raise DumpError(f"{described}: {size:,} bytes, the limit is {MOST_JSON:,}")
    try:
        info = DumpInfo.model_validate_json(described.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "the file"
        raise DumpError(f"{described}: {key}: {first['msg']}; was it written by this version?") from None
    scene, mesh = _with_mesh(info.scene, str(folder / MESH))
    if mesh is not None and str(mesh) != MESH:
        raise DumpError(f"{described}: a dump may name no STL file but its own {MESH}, not {mesh}")
    dump = Dump(info.model_copy(update={"scene": scene}), _read_arrays(folder / "state.npz"))
    try:
        _require_sound(info)
        _ = dump.order
    except ValueError as error:
        raise DumpError(f"{described}: {error}") from None
    for name in ("poses", "rates", "speed"):
        if name in dump.states["before"] and not np.isfinite(dump.states["before"][name]).all():
            raise DumpError(f"{folder / 'state.npz'}: before.{name}: not all of its numbers are finite")
    return dump


def _require_sound(info: DumpInfo) -> None:
    """Raises ValueError that names the key, for frames that the scene does not drive, or lacks, and poses that are
    none."""
    sensors = info.scene.sensors
    frames = sensors if info.scene.indenter is None else (*sensors, "indenter")
    for key, numbers in (("poses", info.poses), ("failed_poses", info.failed_poses), ("targets", info.targets)):
        missing = set() if key == "targets" or not (numbers or key == "poses") else set(frames) - set(numbers)
        wrong = sorted((set(numbers) - set(frames)) | missing)
        if wrong:
            raise ValueError(f"{key}.{wrong[0]}: this scene drives {', '.join(frames)}")
        for name, pose in numbers.items():
            try:
                _poses({name: pose})
            except ValueError as error:
                raise ValueError(f"{key}.{name}: {error}") from None
    for name, load in info.loads.items():
        if name not in sensors or load < 0:
            raise ValueError(f"loads.{name}: must be 0 N or more on one of {', '.join(sensors)}, found {load:g}")


def _read_arrays(path: Path) -> dict[str, dict[str, NDArray[Any]]]:
    states: dict[str, dict[str, NDArray[Any]]] = {moment: {} for moment in MOMENTS}
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            total = sum(member.file_size for member in members)
            if len(members) > MOST_ARRAYS or total > MOST_BYTES:
                raise DumpError(
                    f"{path}: {len(members)} arrays of {total:,} bytes; the limits are {MOST_ARRAYS} and {MOST_BYTES:,}"
                )
            for member in members:
                moment, _, name = member.filename.removesuffix(".npy").partition(".")
                if moment not in states or not name.isidentifier():
                    raise DumpError(f"{path}: '{member.filename}' is no array of a dump")
                with archive.open(member) as file:
                    states[moment][name] = _read_array(file, member.file_size, f"{path}: {member.filename}")
    except FileNotFoundError:
        raise DumpError(f"{path} is missing: the dump is incomplete") from None
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise DumpError(f"{path} is damaged: {error}") from None
    return states


def _read_array(file: IO[bytes], size: int, what: str) -> NDArray[Any]:
    """One .npy stream of `size` bytes; its header is believed only if the sizes agree."""
    try:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise DumpError(f"{what}: npy format {version} is not read")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except ValueError as error:
        raise DumpError(f"{what}: {error}") from None
    if dtype.name not in DTYPES or fortran or len(shape) > 6:
        raise DumpError(f"{what}: {dtype} of shape {shape} is no array of a dump")
    wanted = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    data = file.read(size)
    if wanted < 0 or len(data) != wanted:
        raise DumpError(f"{what}: {len(data):,} bytes where shape {shape} of {dtype} needs {wanted:,}")
    return np.frombuffer(data, dtype).reshape(shape).copy()
