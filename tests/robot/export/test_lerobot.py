"""A LeRobot data set holds what the recordings hold, bit for bit; what makes none is refused with nothing left."""

from __future__ import annotations

import itertools
import json
import resource
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

from robot.export.lerobot_files import DataSet
from robot.export.lerobot_mapping import Feature, ImageCounts, column_statistics, frames_per_second, merge_statistics
from robot.open import open_rig
from tacsim import pose as se3
from tacsim.interface import Action, RigSpec
from tacsim.record import schemas
from tacsim.record.reader import read_episode
from tacsim.record.writer import Recorder
from tests.robot.cli.invoked import START, environment, tacsim
from tests.robot.export.lerobot_reader import read_dataset
from tests.robot.export.made_up import NAMES, PERIOD, made_up_step, record

pytestmark = pytest.mark.usefixtures("empty_folder")


def test_a_data_set_equals_the_recordings_bit_for_bit(tmp_path: Path) -> None:
    first, a = record("a.mcap", 5)
    second, b = record("b.mcap", 4, seed=1, goal=6e-3)
    done = tacsim("export", "lerobot", str(first), str(second), "--out", "data/set")
    assert done.exit_code == 0, done.output
    info, columns = read_dataset(tmp_path / "data/set")
    assert (info["fps"], info["total_frames"], info["total_tasks"], info["robot_type"]) == (10, 7, 2, "sim")
    rows = [(step, after) for steps in (a, b) for step, after in itertools.pairwise(steps)]
    for name in NAMES:
        for kind in ("height", "gradient", "flow"):
            recorded = np.stack([getattr(step.frames[name].surface, kind) for step, _ in rows])
            assert recorded.tobytes() == columns[f"observation.{kind}.{name}"].tobytes()
    assert columns["next.reward"].tolist() == [np.float32(after.reward) for _, after in rows]
    assert columns["next.done"].tolist() == [False, False, False, True, False, False, True]
    # a replay of the same recording sees the same pictures
    text = "\n".join(
        (
            "clock: replay\nname: again\nperiod: 0.1\ntask: null\nscene: null\narms: {}\nsensors:",
            *(f"  {name}: {{driver: replay, source: {first}}}" for name in NAMES),
        )
    )
    Path("again.yaml").write_text(text)
    with open_rig("again.yaml") as rig:
        seen = [rig.reset(), *(rig.step(Action())[0] for _ in range(3))]
    for name in NAMES:
        pictures = np.stack([each.tactile[name].image for each in seen])
        assert pictures.std() > 1.0
        assert np.array_equal(pictures, columns[f"observation.images.{name}"][:4])


def test_state_and_action_mean_what_their_names_and_scales_say(tmp_path: Path) -> None:
    path, steps = record("a.mcap")
    assert tacsim("export", "lerobot", str(path), "--out", "set").exit_code == 0
    info, columns = read_dataset(tmp_path / "set")
    about = json.loads(Path("set/meta/tacsim.json").read_text())

    def quantities(key: str, row: int) -> dict[str, float]:
        """In SI units."""
        names = info["features"][key]["names"]
        assert names == list(about["scales"][key])
        values = {name: about["scales"][key][name] * columns[key][row][at] for at, name in enumerate(names)}
        driven = [name for name in names if name.endswith(".pos")]
        assert driven == info["features"]["action"]["names"]  # what LeRobot's rollout drives back to its start by
        return {name.removesuffix(".pos").removesuffix(".vel"): value for name, value in values.items()}

    asked = {name: steps[0].arms[name].pose for name in NAMES}
    for row, (step, after) in enumerate(itertools.pairwise(steps)):
        state, action = quantities("observation.state", row), quantities("action", row)
        assert after.action is not None
        asked |= {name: target for name, target in after.action.tool.items() if target is not None}
        for name in NAMES:
            start, arm = steps[0].arms[name].pose, step.arms[name]
            for found, pose in ((state, arm.pose), (action, asked[name])):
                position = [found[f"moved_{axis}_{name}"] for axis in "xyz"]
                columns_of_turn = [found[f"turn_{c}{axis}_{name}"] + (c == axis) for c in "xy" for axis in "xyz"]
                away = se3.pose_distance(se3.compose(start, se3.from_rotation_columns(position, columns_of_turn)), pose)
                assert max(away) < 1e-6
            wrench = [state[f"{what}_{axis}_{name}"] for what in ("force", "torque") for axis in "xyz"]
            assert np.allclose(wrench, arm.wrench, rtol=1e-6)
            surface = step.frames[name].surface
            assert surface is not None and surface.flow is not None
            assert np.isclose(state[f"depth_greatest_{name}"], surface.height.max(), rtol=1e-6)
            assert np.isclose(state[f"area_{name}"], (surface.height > 20e-6).sum() * 0.25e-3**2, rtol=1e-6)
            assert np.isclose(state[f"shear_y_{name}"], surface.flow[..., 1].mean(), rtol=1e-5, atol=1e-12)


def test_statistics_are_those_of_the_numbers() -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 250, (9, 8, 3), dtype=np.uint8) for _ in range(4)]
    counts = ImageCounts()
    for image in images:
        counts.add(image)
    found, whole = counts.statistics(), np.stack(images) / 255.0
    for name in ("min", "max", "mean", "std"):
        assert np.allclose(found[name].ravel(), getattr(np, name)(whole, axis=(0, 1, 2)))
    exact = np.quantile(whole, 0.9, axis=(0, 1, 2), method="inverted_cdf")
    assert np.array_equal(found["q90"].ravel(), exact) and found["count"].tolist() == [4]
    a, b = rng.normal(size=(5, 3)), rng.normal(3.0, 2.0, size=(8, 3))
    both, together = merge_statistics([column_statistics(a), column_statistics(b)]), np.concatenate([a, b])
    for name in ("min", "max", "mean", "std"):
        assert np.allclose(both[name], getattr(np, name)(together, axis=0))
    assert both["count"].tolist() == [13]
    maps = rng.normal(size=(6, 4, 5, 2))
    assert np.allclose(column_statistics(maps)["std"], maps.std(axis=(0, 1, 2)).reshape(1, 1, 2))


def test_files_are_followed_by_others_by_size(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    data = DataSet(folder, 10, "r", {"observation.state": Feature("float32", (1000,), None)}, file_size=0.1)
    rng = np.random.default_rng(0)
    states = [rng.normal(size=(10, 1000)).astype(np.float32) for _ in range(7)]  # 40 kB each
    for state in states:
        data.add({"observation.state": state}, {}, "t")
    data.close()
    info, columns = read_dataset(folder)
    assert np.array_equal(columns["observation.state"], np.concatenate(states))
    files = sorted((folder / "data").rglob("*.parquet"))
    assert [path.name for path in files] == [f"file-{k:03d}.parquet" for k in range(4)]
    assert all(path.stat().st_size < 0.1 * 2**20 for path in files) and info["total_episodes"] == 7


@pytest.mark.parametrize(("period", "rate"), [(0.1, 10), (33.3333e-3, 30), (1 / 60, 60)])
def test_the_rate_is_a_whole_number_where_there_is_one(period: float, rate: int) -> None:
    assert frames_per_second(period) == rate and isinstance(frames_per_second(period), int)
    assert frames_per_second(0.03) == pytest.approx(100 / 3)


def cut_off() -> list[str]:
    path, _ = record("whole.mcap", 6)
    data = path.read_bytes()
    Path("cut.mcap").write_bytes(data[: data.index(b"tacsim.close") - 3000])
    return ["cut.mcap"]


def no_recording() -> list[str]:
    Path("text.mcap").write_text("hello")
    return [str(record("a.mcap")[0]), "text.mcap"]


def two_rates() -> list[str]:
    record("a.mcap")
    spec = replace(read_episode("a.mcap").meta.spec, period=0.05)
    return ["a.mcap", str(record("b.mcap", spec=spec)[0])]


def other_format() -> list[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schemas, "FORMAT", "99")
        return [str(record("a.mcap")[0])]


def without_pictures() -> list[str]:
    spec = RigSpec({}, NAMES, truth=True, period=PERIOD)
    return [str(record("a.mcap", spec=spec)[0])]


def without_surface() -> list[str]:
    record("a.mcap")
    steps = [made_up_step(k, NAMES, 0) for k in range(4)]
    bare = {name: replace(frame, surface=None) for name, frame in steps[2].frames.items()}
    steps[2] = replace(steps[2], frames=bare)
    with Recorder("b.mcap", read_episode("a.mcap").meta) as recorder:
        for step in steps:
            assert recorder.write(step) and recorder.flush()
    return ["a.mcap", "b.mcap"]


BAD: list[tuple[Callable[[], list[str]], str]] = [
    (cut_off, "cut.mcap was cut off after 5 steps: leave it out, or export these steps (--cut)"),
    (two_rates, "a data set has one rate, but a.mcap has a step every 0.1 s and b.mcap every 0.05 s"),
    (other_format, "a.mcap: episode format '99', but this tacsim reads"),
    (without_pictures, "a.mcap: no sensor"),
    (lambda: [str(record("a.mcap", 1)[0])], "a.mcap has no action"),
    (lambda: [str(record("a.mcap", names=("left/one",))[0])], "'left/one': LeRobot allows no '/' in names"),
    (lambda: [str(record("a.mcap")[0]), str(record("b.mcap", names=("upper",))[0])], "a.mcap and b.mcap do not fit"),
    (lambda: ["none.mcap"], "none.mcap: no such file"),
    (no_recording, "text.mcap: not an MCAP file"),
    (without_surface, "b.mcap: step 2 lacks data that the recording declares: the policy sees heights"),
]


@pytest.mark.parametrize(("make", "words"), BAD, ids=lambda value: getattr(value, "__name__", "")[:20])
def test_what_makes_no_data_set_is_refused_and_nothing_left(
    make: Callable[[], list[str]], words: str, tmp_path: Path
) -> None:
    given = make()
    before = sorted(tmp_path.iterdir())
    done = tacsim("export", "lerobot", *given, "--out", "data/set")
    assert done.exit_code == 2 and words in done.stderr.replace("\n", " "), done.stderr
    assert sorted(tmp_path.iterdir()) == before


def test_a_recording_that_was_cut_off_is_taken_when_asked(tmp_path: Path) -> None:
    done = tacsim("export", "lerobot", *cut_off(), "--out", "set", "--cut", "--no-maps", "--task", "press it")
    assert done.exit_code == 0, done.output
    info, columns = read_dataset(tmp_path / "set")
    assert info["total_frames"] == 4 and columns["next.done"].tolist() == [False, False, False, True]
    assert not [name for name in info["features"] if "height" in name]
    assert parquet.read_table("set/meta/tasks.parquet")["task"].to_pylist() == ["press it"]


def test_an_existing_folder_is_left_alone(tmp_path: Path) -> None:
    path, _ = record("a.mcap")
    (tmp_path / "set").mkdir()
    done = tacsim("export", "lerobot", str(path), "--out", "set")
    assert done.exit_code == 2 and "set exists already" in done.stderr
    assert list((tmp_path / "set").iterdir()) == []


@pytest.mark.slow
def test_a_full_disk_leaves_nothing_half(tmp_path: Path) -> None:
    path, _ = record("a.mcap", 4)
    process = subprocess.run(
        [*START, "export", "lerobot", str(path), "--out", "set"],
        env=environment(),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000)),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 1 and "set: " in process.stderr and "File too large" in process.stderr
    assert sorted(tmp_path.iterdir()) == [tmp_path / "a.mcap"]
