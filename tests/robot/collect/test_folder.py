"""A set that was killed anywhere goes on to the same files; anything else in its folder is refused, and stays."""

from __future__ import annotations

import json
import shlex
import shutil
import signal
import subprocess
import time
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.collect.collect import collect
from robot.collect.folder import open_set
from robot.collect.objects import find_objects
from robot.collect.workers import Piece, SetError, Stopped
from robot.common import whole_file
from robot.common.cluster import ClusterError
from tacsim.config import load_scene
from tacsim.models.scene import Sphere
from tests.robot.cli.invoked import START, environment, plain_text, tacsim
from tests.robot.collect.small import contents, job, rows

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "set"
    collect(job(5), path, {}, "x")
    return path


class Killed(BaseException):
    """Stands for a kill: nothing after it runs."""


@pytest.mark.parametrize(("at", "left"), [(1, 5), (2, 5), (3, 5), (4, 5), (5, 3), (6, 1)])
def test_killed_at_any_write_it_goes_on_to_the_same_files(
    at: int, left: int, whole: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Written are: what the set is of, the reference picture, the card, then file after file."""
    count, real = 0, Path.replace

    def kill(self: Path, target: Any) -> Any:
        nonlocal count
        count += 1
        if count == at:
            raise Killed
        return real(self, target)

    monkeypatch.setattr(Path, "replace", kill)
    with pytest.raises(Killed):
        collect(job(5), tmp_path / "set", {}, "x")
    monkeypatch.undo()
    assert collect(job(5), tmp_path / "set", {}, "x").made == left
    assert contents(tmp_path / "set") == contents(whole)
    assert [row["index"] for row in rows(tmp_path / "set")] == [0, 1, 2, 3, 4]


def test_a_file_is_the_same_whoever_makes_it_and_in_whatever_order(whole: Path, tmp_path: Path) -> None:
    made = job(5)
    worker = made.worker(tmp_path)
    for number in (2, 0, 1):
        assert worker.piece(number).data == (whole / made.name(number)).read_bytes()


def test_stopped_it_keeps_what_is_written_and_goes_on(whole: Path, tmp_path: Path) -> None:
    asked = iter([False, False, True])
    with pytest.raises(Stopped):
        collect(job(5), tmp_path / "set", {}, "x", stop=lambda: next(asked))
    assert len(rows(tmp_path / "set")) == 4
    told: list[tuple[int, int]] = []
    assert collect(job(5), tmp_path / "set", {}, "x", report_progress=lambda *now: told.append(now)).made == 1
    assert told == [(4, 5), (5, 5)]
    assert contents(tmp_path / "set") == contents(whole)


def test_more_presses_make_a_set_longer(whole: Path, tmp_path: Path) -> None:
    collect(job(3), tmp_path / "set", {}, "x")
    assert collect(job(5), tmp_path / "set", {}, "x").made == 3  # the last file was cut short: made anew
    assert contents(tmp_path / "set") == contents(whole)
    with pytest.raises(SetError, match="its count is 5, the requested count is 3"):
        collect(job(3), tmp_path / "set", {}, "x")


def test_another_command_is_refused_and_nothing_changes(whole: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in whole.rglob("*")}
    with pytest.raises(SetError, match=r"another command \(x\): seed is 0 there and 7 here"):
        collect(job(5, seed=7), whole, {}, "y")
    with pytest.raises(SetError, match=r"files.objects/a.stl is null there and .* here"):
        collect(job(5), whole, {"objects/a.stl": b"solid"}, "y")
    with pytest.raises(SetError, match=r"scene.indenter.friction is 0.6 there and 0.3 here"):
        collect(job(5, scene=load_scene("press", ["preset=learn", "indenter.friction=0.3"])), whole, {}, "y")
    assert {path: path.stat().st_mtime_ns for path in whole.rglob("*")} == before


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full/thesis.txt").write_text("mine")
    with pytest.raises(SetError, match="exists, but holds no set"):
        collect(job(1), tmp_path / "full", {}, "x")
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["thesis.txt"]
    (tmp_path / "full/collect.json").write_text("{}")
    with pytest.raises(SetError, match=r"collect\.json cannot be read"):
        collect(job(1), tmp_path / "full", {}, "x")


def test_what_was_damaged_is_named_with_what_to_do(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "set")
    for text in ('{"index": 1, "rea', '{"index": 1}', "[1]"):
        (tmp_path / "set/failures.jsonl").write_text(text)
        with pytest.raises(SetError, match=r"failures\.jsonl cannot be read; delete it"):
            collect(job(5), tmp_path / "set", {}, "x")
    (tmp_path / "set/failures.jsonl").unlink()
    (tmp_path / "set/data/train-00001.parquet").write_bytes(b"PAR1 no table")
    with pytest.raises(SetError, match=r"train-00001\.parquet is damaged; delete it"):
        collect(job(5), tmp_path / "set", {}, "x")
    (tmp_path / "set/data/train-00001.parquet").unlink()
    collect(job(5), tmp_path / "set", {}, "x")
    assert contents(tmp_path / "set") == contents(whole)


def test_who_begins_at_the_same_time_waits_for_who_was_faster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, made = whole_file.tempfile.mkdtemp, job(1)

    def late(**place: Any) -> str:
        monkeypatch.undo()
        monkeypatch.chdir(tmp_path)
        held.enter_context(open_set(tmp_path / "set", made, made.settings.model_dump(mode="json"), {}, "x"))
        return str(real(**place))

    monkeypatch.setattr(whole_file.tempfile, "mkdtemp", late)
    with ExitStack() as held, pytest.raises(SetError, match="another tacsim collect works in this folder"):
        collect(made, tmp_path / "set", {}, "x")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_nobody_else_writes_meanwhile(tmp_path: Path) -> None:
    made = job(1)
    with (
        open_set(tmp_path / "set", made, made.settings.model_dump(mode="json"), {}, "x"),
        pytest.raises(SetError, match="another tacsim collect works in this folder"),
    ):
        collect(made, tmp_path / "set", {}, "x")


def test_a_full_disk_names_the_file_and_leaves_whole_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = 0

    def full(number: int) -> None:
        nonlocal written
        written += 1
        if written == 5:  # notes, reference, card, a file
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(whole_file.os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as raised:
        collect(job(5), tmp_path / "set", {}, "x")
    assert str(raised.value.filename).endswith("train-00001.parquet")
    assert [path.name for path in (tmp_path / "set/data").iterdir()] == ["train-00000.parquet"]
    monkeypatch.undo()
    assert collect(job(5), tmp_path / "set", {}, "x").made == 3


def test_a_full_disk_at_the_begin_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(number: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(whole_file.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        collect(job(1), tmp_path / "set", {}, "x")
    assert list(tmp_path.iterdir()) == []


def test_a_piece_where_all_fails_is_done_without_a_file(tmp_path: Path) -> None:
    objects = {"pin": Sphere(radius=0.1e-3)}
    done = collect(job(4, objects=objects), tmp_path / "set", {}, "x")
    assert done.made == 0 and list(done.failures) == [0, 1, 2, 3]
    assert not (tmp_path / "set/data").exists()
    asked = collect(job(4, objects=objects), tmp_path / "set", {}, "x")
    assert asked.seconds == {}


@pytest.mark.skipif(find_spec("ray") is not None, reason="ray is here")
def test_without_ray_it_says_what_to_install_and_begins_nothing(tmp_path: Path) -> None:
    with pytest.raises(ClusterError, match=r"pip install 'tacsim\[cluster\]'"):
        collect(job(2), tmp_path / "set", {}, "x", cluster="auto")
    assert not (tmp_path / "set").exists()


@pytest.mark.deep
def test_killed_by_a_signal_that_nobody_can_catch_it_goes_on_to_the_same_files(tmp_path: Path) -> None:
    """Two workers, kill -9 of the command, twice; workers end with it. Against one process that nobody killed."""
    words = ("collect", "press", "--objects", "stl", "--preset", "learn", "--count", "300", "--workers")
    _balls(tmp_path / "stl")
    assert tacsim(*words, "1", "--out", "whole").exit_code == 0
    for least in (1, 3):
        process = subprocess.Popen([*START, *words, "2", "--out", "set"], env=environment())
        _wait_for(lambda least=least: len(list(Path("set/data").glob("train-*"))) >= least)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert len(list(Path("set/data").glob("train-*.parquet"))) < 6
    assert tacsim(*words, "2", "--out", "set").exit_code == 0
    assert contents(Path("set")) == contents(Path("whole"))
    assert [row["index"] for row in rows(Path("set"))] == list(range(300))


@pytest.mark.deep
def test_a_signal_ends_the_workers_and_says_how_to_go_on(tmp_path: Path) -> None:
    """Each has a piece in hand that would take minutes."""
    _balls(tmp_path / "stl")
    words = ("collect", "press", "--objects", "stl", "--preset", "standard", "--count", "1000", "--workers", "2")
    process = subprocess.Popen([*START, *words, "--out", "set"], env=environment(), stderr=subprocess.PIPE, text=True)
    _wait_for(lambda: len(_children(process.pid)) >= 2)
    children = _children(process.pid)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=20)
    assert process.returncode == 128 + signal.SIGTERM
    assert "0 of 1000 are finished. Run the same command again to continue" in said
    _wait_for(lambda: not any(Path(f"/proc/{child}").exists() for child in children))


def _children(pid: int) -> list[int]:
    found = subprocess.run(["pgrep", "-P", str(pid), "-f", "spawn_main"], capture_output=True, text=True).stdout
    return [int(word) for word in found.split()]


def _wait_for(there: Any) -> None:
    for _ in range(600):
        if there():
            return
        time.sleep(0.05)
    raise AssertionError("waited for 30 s")


def _balls(folder: Path) -> None:
    from trimesh import creation

    folder.mkdir()
    for name, radius in (("a", 0.9), ("b c", 1.2)):
        creation.icosphere(2, radius).export(folder / f"{name}.stl")


@pytest.mark.slow
def test_the_command_makes_a_set_of_a_folder_of_objects(tmp_path: Path) -> None:
    _balls(tmp_path / "stl")
    words = ("collect", "press", "--objects", "stl", "--depth", "0.2..0.4mm", "--preset", "learn", "--count", "2")
    done = tacsim(*words, "--workers", "1", "--shear", "0.1 mm", "--out", "set")
    assert done.exit_code == 0, done.output
    assert "2 made in" in done.output and "by 1: " in done.output
    assert {path.name for path in (tmp_path / "set").iterdir()} == {
        "README.md", "collect.json", "data", "objects", "reference.png",
    }  # fmt: skip
    about = json.loads(Path("set/collect.json").read_text())
    assert about["settings"]["depth"] == pytest.approx([0.2e-3, 0.4e-3])
    made = [np.linalg.norm(row["shear"]) for row in rows(tmp_path / "set")]
    assert made == pytest.approx([0.1e-3, 0.1e-3])
    # the command that the card names makes it again
    again = about["command"].replace("--out set", "--out again --workers 1")
    assert tacsim(*shlex.split(again)[1:]).exit_code == 0
    assert contents(tmp_path / "again") == contents(tmp_path / "set")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--objects", "nothing"), "is not a folder; give a folder of mesh files, or 'shapes'"),
        (("--objects", "empty"), "empty holds no mesh file"),
        (("--objects", "broken"), "stl: is no STL"),
        (("--depth", "1..0.1mm"), "goes from the larger to the smaller"),
        (("--depth", "0.1..5mm"), "it must be above 0 and below the gel's 4 mm"),
        (("--depth", "0.1..1"), "has no unit"),
        (("--shear", "0.1..1deg"), "'0.1deg'"),
        (("--sensor", "nobody"), "nobody"),
        (("--ray", "local"), "pip install 'tacsim[cluster]'"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(words: tuple[str, ...], says: str, tmp_path: Path) -> None:
    from importlib.util import find_spec

    if "--ray" in words and find_spec("ray") is not None:
        pytest.skip("ray is installed")
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/stl.stl").write_text("no mesh")
    own = ("--objects", "few") if "--objects" not in words else ()
    if own:
        _balls(tmp_path / "few")
    done = tacsim("collect", "press", "--preset", "learn", "--count", "1", *own, *words, "--out", "set")
    assert done.exit_code == 2 and says in plain_text(done.output)
    if "--ray" not in words:
        assert not (tmp_path / "set").exists()


def test_all_broken_files_are_named_together(tmp_path: Path) -> None:
    (tmp_path / "stl").mkdir()
    for name in ("a", "b"):
        (tmp_path / f"stl/{name}.stl").write_text("no mesh")
    (tmp_path / "stl/a.STL").write_text("no mesh")
    with pytest.raises(ValueError, match=r"(?s)a\.STL.*a\.stl.*b\.stl.*two files are called a"):
        find_objects("stl", 1e-3)


def test_find_objects_reads_mesh_files_of_each_kind_and_unit(tmp_path: Path) -> None:
    """A ball of 6 mm in millimetres as STL, and in metres as OBJ and PLY."""
    from trimesh import creation

    (tmp_path / "meshes").mkdir()
    for name, unit in (("a.stl", 1e-3), ("b.OBJ", 1.0), ("c.ply", 1.0)):
        creation.icosphere(1, 3e-3 / unit).export(tmp_path / "meshes" / name, file_type=name[2:].lower())
    objects, files = find_objects("meshes", None)
    assert {name: each.model_dump()["scale"] for name, each in objects.items()} == {"a": 1e-3, "b": 1.0, "c": 1.0}
    assert list(files) == ["objects/a.stl", "objects/b.obj", "objects/c.ply"]


def test_a_piece_that_comes_twice_is_written_once(tmp_path: Path) -> None:
    """As Ray may send it."""
    made = job(2)
    with open_set(tmp_path / "set", made, made.settings.model_dump(mode="json"), {}, "x") as place:
        place.write_piece(Piece(0, b"first", {}, 2))
        place.write_piece(Piece(0, b"second", {}, 2))
        assert place.missing == [] and (place.path / made.name(0)).read_bytes() == b"first"
