"""Dumps of diverged motions: written where asked, replayable to the last bit, and read with suspicion."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacsim.interface import Pose
from tacsim.models.scene import Gel, Indenter, Mesh, Scene, Settling, Sphere
from tacsim.physics.failure import dump
from tacsim.physics.failure.dump import DumpError, dump_to_folder, read_dump
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.failure.tuning import MAX_DUMPS
from tacsim.physics.worlds.press import PressWorld

TOO_DEEP = 5e-3
SCENE = Scene(
    body=None,
    indenter=Indenter(geometry=Sphere(radius=3e-3)),
    gel=Gel(size=(6e-3, 6e-3, 4e-3)),
    settling=Settling(mach=0.1, max_substeps=200),
)


def press_through(world: PressWorld) -> SimulationDiverged:
    pose = world.pose("indenter")
    with pytest.raises(SimulationDiverged) as caught:
        world.move({"indenter": Pose(pose.position - [0, 0, TOO_DEEP])})
    return caught.value


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dump of an indenter driven through a gel."""
    folder = tmp_path_factory.mktemp("dumps") / "diverged"
    with dump_to_folder(folder):
        failure = press_through(PressWorld(SCENE))
    assert failure.dump == folder / "00"
    assert str(failure).endswith(f"tacsim debug {folder / '00'}")
    return folder / "00"


@pytest.fixture
def copied(made: Path, tmp_path: Path) -> Path:
    place = tmp_path / "00"
    place.mkdir()
    for name in ("dump.json", "state.npz"):
        (place / name).write_bytes((made / name).read_bytes())
    return place


def test_without_a_folder_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(dump.FOLDER, raising=False)
    failure = press_through(PressWorld(SCENE))
    assert failure.dump is None and "tacsim debug" not in str(failure)
    assert str(failure).endswith("; set TACSIM_DUMPS to a folder to keep a replayable state")
    assert list(tmp_path.iterdir()) == []


def test_a_dump_that_cannot_be_written_whole_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with dump_to_folder(tmp_path):
        failure = press_through(PressWorld(SCENE))
    assert failure.dump is None and "No space left on device" in str(failure)
    assert list(tmp_path.iterdir()) == []


def test_the_environment_goes_before_the_folder_of_a_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(dump.FOLDER, str(tmp_path / "mine"))
    with dump_to_folder(tmp_path / "theirs"):
        assert os.environ[dump.FOLDER] == str(tmp_path / "mine")
        with dump_to_folder(None):
            assert os.environ[dump.FOLDER] == ""
    assert os.environ[dump.FOLDER] == str(tmp_path / "mine")
    monkeypatch.delenv(dump.FOLDER)
    with dump_to_folder(tmp_path / "theirs"):
        assert os.environ[dump.FOLDER] == str(tmp_path / "theirs")
    assert dump.FOLDER not in os.environ


@pytest.mark.cpu
def test_it_holds_all_that_a_replay_needs(made: Path) -> None:
    found = read_dump(made)
    assert found.info.scene == SCENE
    assert found.command.targets["indenter"].position == pytest.approx([0, 0, 3.1e-3 - TOO_DEEP])
    assert found.poses("before")["indenter"].position == pytest.approx([0, 0, 3.1e-3])
    assert found.poses("failed")["indenter"].position[2] < 3.1e-3
    assert found.info.versions["numpy"] == np.__version__ and "even with 1/4 of the time step" in found.info.message
    world = PressWorld(found.info.scene)
    world.restore(found.states["before"])
    failure = press_through(world)
    assert str(failure).startswith(found.info.message)  # then, that no dump was asked for
    for moment, state in (("good", failure.good), ("failed", failure.failed)):
        assert {name: a.tobytes() for name, a in state.items()} == {
            name: a.tobytes() for name, a in found.states[moment].items()
        }, moment


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stl", "ply"])
def test_dump_holds_the_mesh_file(tmp_path: Path, kind: str) -> None:
    import trimesh

    path = tmp_path / f"ball.{kind}"
    path.write_bytes(trimesh.creation.icosphere(subdivisions=2, radius=3.0).export(file_type=kind))
    scene = SCENE.model_copy(update={"indenter": Indenter(geometry=Mesh(path=str(path)))})
    with dump_to_folder(tmp_path / "out"):
        press_through(PressWorld(scene))
    path.unlink()
    found = read_dump(tmp_path / "out" / "00")
    assert found.info.scene.indenter is not None
    geometry = found.info.scene.indenter.geometry
    assert isinstance(geometry, Mesh) and Path(geometry.path) == tmp_path / "out" / "00" / f"shape.{kind}"
    assert press_through(PressWorld(found.info.scene)).cause in found.info.message
    edit(tmp_path / "out" / "00", lambda d: d["scene"]["indenter"]["geometry"].update(path="/etc/hosts"))
    assert read_dump(tmp_path / "out" / "00").info.scene == found.info.scene  # a dump names no file but its own


def test_dumps_are_numbered_and_few(tmp_path: Path) -> None:
    world = PressWorld(SCENE)
    with dump_to_folder(tmp_path):
        assert [press_through(world).dump for _ in range(2)] == [tmp_path / "00", tmp_path / "01"]
        for number in range(2, MAX_DUMPS):
            (tmp_path / f"{number:02d}").mkdir()
        failure = press_through(world)
    assert failure.dump is None and "no dump could be written" in str(failure) and "holds 20 dumps" in str(failure)


def test_a_folder_that_cannot_be_written_does_not_hide_the_failure(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with dump_to_folder(tmp_path / "file" / "below"):
        failure = press_through(PressWorld(SCENE))
    assert "gel" in failure.cause and "no dump could be written" in str(failure)


def edit(place: Path, change: Any) -> None:
    info = json.loads((place / "dump.json").read_text())
    change(info)
    (place / "dump.json").write_text(json.dumps(info))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(format="tacsim dump 9"), "format"),
        (lambda d: d.pop("targets"), "targets: Field required"),
        (lambda d: d["scene"].update(gel="soft"), "scene.gel"),
        (lambda d: d.update(more=1), "more: Extra inputs"),
    ],
)
def test_facts_that_are_wrong_are_named(copied: Path, change: Any, words: str) -> None:
    edit(copied, change)
    with pytest.raises(DumpError, match=words):
        read_dump(copied)


def rewrite(place: Path, name: str, data: bytes) -> None:
    with zipfile.ZipFile(place / "state.npz", "a") as archive:
        archive.writestr(name, data)


def npy(array: np.ndarray, **options: Any) -> bytes:
    import io

    file = io.BytesIO()
    np.lib.format.write_array(file, array, **options)
    return file.getvalue()


def test_arrays_that_cannot_be_read_are_refused(copied: Path) -> None:
    sound = (copied / "state.npz").read_bytes()

    def refused(words: str) -> None:
        with pytest.raises(DumpError, match=words):
            read_dump(copied)
        (copied / "state.npz").write_bytes(sound)

    rewrite(copied, "before.objects.npy", npy(np.array([{"a": 1}], dtype=object), allow_pickle=True))
    refused("Object arrays cannot be loaded")  # nothing in a dump is executed
    rewrite(copied, "before.lying.npy", npy(np.zeros(8, np.float32)).replace(b"(8,)", b"(9,)"))
    refused("damaged")
    rewrite(copied, "../escape.npy", npy(np.zeros(1)))
    refused("damaged")
    (copied / "state.npz").write_bytes(sound[: len(sound) // 2])
    refused("damaged")
    (copied / "state.npz").unlink()
    with pytest.raises(DumpError, match="missing or damaged"):
        read_dump(copied)
    with pytest.raises(FileNotFoundError, match=r"no dump\.json"):
        read_dump(copied / "nowhere")


def test_a_process_started_meanwhile_dumps_to_the_same_folder(tmp_path: Path) -> None:
    with dump_to_folder(tmp_path):
        code = "import os; print(os.environ['TACSIM_DUMPS'])"
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True)
    assert said.stdout.strip() == str(tmp_path)
