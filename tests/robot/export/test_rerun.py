"""An episode in Rerun: every entity is there on one time line, in a file that its own reader takes for whole."""

from __future__ import annotations

import resource
import subprocess
import sys
from dataclasses import replace
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.export.rerun_log import EpisodeLog, _colours, _triangles, blueprint
from robot.rig.recorded import observe_episode
from tacsim.optics.grid import canonical_cells
from tests.robot.cli.invoked import START, environment, plain_text, tacsim
from tests.robot.export.made_up import NAMES, record

needs_rerun = pytest.mark.skipif(util.find_spec("rerun") is None, reason="needs the extra 'viz'")


pytestmark = pytest.mark.usefixtures("empty_folder")


def test_triangles_join_valid_cells_alone_and_cover_them_once() -> None:
    valid = np.ones((4, 5), bool)
    valid[0, 0] = valid[3, 4] = False
    cells = np.argwhere(valid)[:, ::-1].astype(float)  # x, y in the order in which they are counted
    corners = cells[_triangles(valid)]
    (ax, ay), (bx, by) = (np.moveaxis(corners[:, k] - corners[:, 0], 1, 0) for k in (1, 2))
    areas = 0.5 * (ax * by - ay * bx)
    assert np.allclose(areas, 0.5)  # all turn one way
    assert areas.sum() == 12 - 2  # squares, but for those with a corner that is missing


def test_colours_grow_with_depth_and_end() -> None:
    colours = _colours(np.array([-1e-3, 0.0, 1e-3, 9.0])).tolist()
    assert colours[0] == colours[1] and colours[2] == colours[3] and colours[1] != colours[2]


@pytest.mark.skipif(util.find_spec("rerun") is not None, reason="rerun is here")
def test_without_rerun_it_says_what_to_install() -> None:
    path, _ = record("a.mcap", 2)
    done = tacsim("view", str(path), "--save", "a.rrd")
    assert done.exit_code == 2 and "pip install 'tacsim[viz]'" in done.stderr.replace("\n", " ")


class Kept:
    """Takes the place of a recording of Rerun."""

    def __init__(self) -> None:
        self.now: dict[str, float] = {}
        self.logged: dict[str, list[tuple[dict[str, float], Any]]] = {}

    def set_time(self, timeline: str, *, sequence: int | None = None, duration: float | None = None) -> None:
        self.now[timeline] = float(sequence if duration is None else duration)

    def log(self, entity: str, value: Any, *, static: bool = False) -> None:
        self.logged.setdefault(entity, []).append(({} if static else dict(self.now), value))


@needs_rerun
def test_all_of_a_step_is_logged_at_its_time() -> None:
    path, steps = record("a.mcap", 3)
    observed, kept = observe_episode(path), Kept()
    lattice = np.zeros((5, 7, 2))
    log = EpisodeLog(kept, observed.episode.meta.spec, observed.canonical, dict.fromkeys(NAMES, lattice))  # type: ignore[arg-type]
    seen = []
    for step, observation in observed.steps():
        log.step(step, observation)
        seen.append(observation.tactile["upper"])
    wanted = {f"{kind}/{name}" for kind in ("world", "world/asked", "camera", "canonical") for name in NAMES}
    wanted |= {f"world/{name}/{part}" for name in NAMES for part in ("gel", "flow", "force")}
    wanted |= {f"{kind}/{name}/{axis}" for kind in ("force", "torque") for name in NAMES for axis in "xyz"}
    assert wanted | {"world", "task/reward", "task/distance", "diagnostics/seconds"} == set(kept.logged)
    assert [at for at, _ in kept.logged["force/upper/z"]] == [
        {"time": pytest.approx(0.1 * k), "step": k} for k in range(3)
    ]
    forces = [value.scalars.as_arrow_array().to_pylist() for _, value in kept.logged["force/upper/z"]]
    assert forces == [[step.arms["upper"].wrench[2]] for step in steps]
    (_, triangles), *meshes = kept.logged["world/upper/gel"]
    assert kept.logged["world/upper/gel"][0][0] == {} and triangles.vertex_positions is None
    corners = np.array(meshes[1][1].vertex_positions.as_arrow_array().to_pylist())
    height, valid = seen[1].height, seen[1].valid
    assert height is not None
    assert np.allclose(corners[:, 2], -height[valid]) and np.ptp(corners[:, 2]) > 1e-3  # pressed in: below the rest
    assert np.allclose(corners[:, :2], canonical_cells(observed.canonical).points()[valid])


@needs_rerun
def test_view_opens_at_the_gels_with_diagnostics_in_another_tab() -> None:
    import rerun.blueprint as rrb

    path, steps = record("a.mcap", 2)
    spec = observe_episode(path).episode.meta.spec
    tabs = blueprint(spec, steps[0].arms).root_container
    assert isinstance(tabs, rrb.Tabs) and tabs.active_tab == 0
    episode, diagnostics = tabs.contents
    assert (episode.name, diagnostics.name) == ("episode", "diagnostics")
    space = episode.contents[0]
    eye = space.properties["EyeControls3D"]
    positions = np.array([state.pose.position for state in steps[0].arms.values()])
    target = np.array(eye.look_target.as_arrow_array().to_pylist()[0])
    assert np.allclose(target, positions.mean(axis=0))
    distance = np.linalg.norm(np.array(eye.position.as_arrow_array().to_pylist()[0]) - target)
    assert 0.1 < np.ptp(positions, axis=0).max() / 2 / distance < 0.4  # half of what is looked at fills 6 to 22 degrees


@needs_rerun
def test_recorded_particles_are_shown() -> None:
    path, _ = record("a.mcap", 2)
    observed, kept = observe_episode(path), Kept()
    log = EpisodeLog(kept, observed.episode.meta.spec, observed.canonical, {})  # type: ignore[arg-type]
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    for step, observation in observed.steps():
        log.step(replace(step, body=points), observation)
    shown = [value.positions.as_arrow_array().to_pylist() for _, value in kept.logged["world/body"]]
    assert shown == [points.tolist()] * 2


def test_a_rig_is_looked_at_live_and_hardware_does_not_move(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr("robot.cli.recordings.run", lambda rig, **more: asked.append((rig, more)))
    assert tacsim("view", "ur5e-one", "--steps", "3").exit_code == 0
    assert tacsim("view", "sim", "--task", "squeeze", "--save", "live.rrd").exit_code == 0
    (first, one), (second, two) = asked
    assert (first, one["dry_run"], one["view"], one["save_view"], one["steps"]) == ("ur5e-one", True, True, None, 3)
    assert (second, two["dry_run"], two["view"], two["task"]) == ("sim", False, False, "squeeze")
    assert two["save_view"] == Path("live.rrd")
    wrong = tacsim("view", "no-such-rig")
    assert wrong.exit_code == 2 and "no rig 'no-such-rig'" in wrong.stderr.replace("\n", " ")
    Path("first").mkdir()
    assert "name the episode.mcap in it" in plain_text(tacsim("view", "first").stderr)
    path, _ = record("a.mcap", 2)
    assert "for rigs" in tacsim("view", str(path), "--steps", "3").stderr


@needs_rerun
def test_the_file_is_whole_and_never_written_over(tmp_path: Path) -> None:
    path, _ = record("a.mcap", 3)
    assert tacsim("view", str(path), "--save", "a.rrd").exit_code == 0
    command = [sys.executable, "-m", "rerun", "rrd", "verify", "a.rrd"]
    verified = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert verified.returncode == 0 and "1 file verified without error" in verified.stdout + verified.stderr
    before = Path("a.rrd").read_bytes()
    again = tacsim("view", str(path), "--save", "a.rrd")
    assert again.exit_code == 2 and "a.rrd: exists already" in again.stderr
    assert Path("a.rrd").read_bytes() == before
    assert tacsim("view", str(path), "--save", "a.txt").exit_code == 2
    assert "none.mcap: no such file" in tacsim("view", "none.mcap", "--save", "none/b.rrd").stderr
    assert "a.mcap" in tacsim("view", str(path), "--save", "a.mcap/b.rrd").stderr
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.mcap", "a.rrd"]


@needs_rerun
def test_a_full_disk_leaves_no_file(tmp_path: Path) -> None:
    path, _ = record("a.mcap", 5)

    process = subprocess.run(
        [*START, "view", str(path), "--save", "a.rrd"],
        env=environment() | {"RUST_LOG": "off"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000)),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 1 and "a.rrd: File too large" in process.stderr
    assert sorted(tmp_path.iterdir()) == [tmp_path / "a.mcap"]
