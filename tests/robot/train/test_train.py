"""Training runs: what is learned, what a kill leaves, and the file at the end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

import onnx  # noqa: E402
import onnxruntime  # noqa: E402

from robot.deploy.onnx_policy import OnnxPolicy  # noqa: E402
from robot.train.dagger import MIN_SPREAD, infer_actions  # noqa: E402
from robot.train.network import MAX_BYTES, MAX_DEVIATIONS, ExportError, FeatureLayers, PolicyNetwork, export  # noqa: E402  # noqa: E402
from robot.train.run_folder import FORMAT, RunError, RunFolder  # noqa: E402
from robot.train.train import begin_run, export_policy, make_environments, new_actor, train  # noqa: E402
from tacsim.config import ConfigError  # noqa: E402
from tacsim.control import NoTouch  # noqa: E402
from tacsim.models.policy import Training  # noqa: E402
from tacsim.tasks import BadDraws, GoalOutOfReach  # noqa: E402
from tests.robot.cli.invoked import START, environment, tacsim  # noqa: E402
from tests.robot.train.short import training  # noqa: E402
from tests.tacsim.gym.small import touch_nothing_slippery  # noqa: E402

ALGORITHMS = ("dagger", "ppo", "sac")


def weights(run: RunFolder) -> dict[str, Any]:
    """All numbers of the last checkpoint."""
    found: dict[str, Any] = {}

    def walk(value: Any, at: str) -> None:
        if isinstance(value, dict):
            for key, each in value.items():
                walk(each, f"{at}.{key}")
        elif isinstance(value, torch.Tensor):
            found[at] = value.numpy().tobytes()
        elif isinstance(value, int | float):
            found[at] = value

    walk(run.load_checkpoint()[1], "")
    return found


class Killed(Exception):
    """Stands for a kill: nothing after it runs."""


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_train_killed_run_continues_bit_for_bit(algorithm: str, tmp_path: Path) -> None:
    settings = training(algorithm=algorithm)
    whole = begin_run(settings, tmp_path / "whole")
    train(whole)

    def kill_in_round_2(words: str, done: int, of: int) -> None:
        if "round 3" in words and done >= of // 2:
            raise Killed

    cut = begin_run(settings, tmp_path / "cut")
    with pytest.raises(Killed):
        train(cut, kill_in_round_2)
    assert cut.load_checkpoint()[0] == 2
    train(RunFolder(tmp_path / "cut"))
    assert weights(cut) == weights(whole) != {}
    assert (tmp_path / "cut/policy.onnx").read_bytes() == (tmp_path / "whole/policy.onnx").read_bytes()
    assert len(json.loads((tmp_path / "cut/curve.json").read_text())) == 3


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_train_in_processes_gives_the_same_policy(algorithm: str, tmp_path: Path) -> None:
    one, two = (begin_run(training(algorithm=algorithm), tmp_path / name) for name in ("one", "two"))
    train(one)
    train(two, processes=2)
    assert weights(one) == weights(two) != {}


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_reinforcement_normalises_features(algorithm: str, tmp_path: Path) -> None:
    run = begin_run(training(algorithm=algorithm), tmp_path / "run")
    train(run)
    actor = run.load_checkpoint()[1]["actor"]
    changed = [key for key, value in actor.items() if key.startswith("layers.mean") and bool((value != 0.0).any())]
    assert len(changed) == len(run.settings.shapes)


@pytest.mark.slow
def test_learning_curve_is_drawn_after_each_round(tmp_path: Path) -> None:
    run = begin_run(training(algorithm="ppo"), tmp_path / "run")
    drawn: list[Image.Image] = []
    train(run, report_result=lambda figures: drawn.append(Image.open(run.folder / "curve.png").convert("RGB")))
    assert len(drawn) == 3
    assert drawn[0].size == (1200, 340)
    lines = [(np.asarray(each) == (0x2A, 0x6D, 0xB5)).all(axis=2).sum() for each in drawn]  # of the distance
    assert 0 < lines[0] < lines[1] < lines[2]


@pytest.mark.slow
def test_tensorboard_has_the_figures_of_each_round(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = begin_run(training(algorithm="ppo"), tmp_path / "run")
    train(run, tensorboard=True)
    (folder,) = (run.folder / "tensorboard").iterdir()
    log = EventAccumulator(str(folder)).Reload()
    curve = json.loads((run.folder / "curve.json").read_text())
    shown = [event.value for event in log.Scalars("round/distance")]
    assert shown == pytest.approx([row["distance"] for row in curve])
    assert "train/loss" in log.Tags()["scalars"]  # what stable-baselines3 logs itself


def test_train_kill_after_last_checkpoint_keeps_curve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, keep = begin_run(training(dagger={"rounds": 1, "epochs": 1}), tmp_path / "run"), RunFolder.save_checkpoint

    def kept_and_killed(*given: Any) -> None:
        keep(*given)
        raise Killed

    monkeypatch.setattr(RunFolder, "save_checkpoint", kept_and_killed)
    with pytest.raises(Killed):
        train(run)
    train(run)
    assert json.loads((run.folder / "curve.json").read_text()) == run.load_checkpoint()[2] != []


def test_train_other_seed_gives_other_policy(tmp_path: Path) -> None:
    ends = []
    for seed in (0, 1):
        run = begin_run(training(seed=seed, dagger={"rounds": 1, "epochs": 1}), tmp_path / str(seed))
        train(run)
        ends.append(weights(run))
    assert ends[0] != ends[1]


def test_train_command_killed_process_can_continue(tmp_path: Path) -> None:
    """kill -9 at an arbitrary time."""
    file = tmp_path / "short.yaml"
    file.write_text(json.dumps(training().model_dump(mode="json", exclude_none=True)), encoding="utf-8")
    command = [*START, "train", str(file), "--out", str(tmp_path / "run")]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        while process.poll() is None and not (tmp_path / "run/checkpoint.pt").exists():
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        assert process.wait() in (-signal.SIGKILL, 0), process.stderr and process.stderr.read()
    result = tacsim("train", "--resume", tmp_path / "run")
    assert result.exit_code == 0, result.output
    whole = begin_run(training(), tmp_path / "whole")
    train(whole)
    assert weights(RunFolder(tmp_path / "run")) == weights(whole)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_train_full_disk_raises_and_keeps_checkpoint(tmp_path: Path) -> None:
    run = begin_run(training(), tmp_path / "run")

    def fill_in_round_2(words: str, done: int, of: int) -> None:
        if "round 2" in words and not (run.folder / ".checkpoint.pt.part").exists():
            (run.folder / ".checkpoint.pt.part").symlink_to("/dev/full")

    with pytest.raises(OSError, match=r"cannot be written") as failed:
        train(run, fill_in_round_2)
    assert failed.value.filename == str(run.folder / "checkpoint.pt")
    assert not (run.folder / ".checkpoint.pt.part").is_symlink()
    assert run.load_checkpoint()[0] == 1
    train(run)
    assert run.load_checkpoint()[0] == 3


@pytest.mark.parametrize("maps", [(), ("height", "slope")])
def test_export_file_acts_like_network(maps: tuple[str, ...], tmp_path: Path) -> None:
    """Normalisation and clipping inside, no other file, metadata: to 1e-5, also far outside the training data."""
    features = {
        "maps": maps,
        "grid": {"rows": 4, "columns": 4, "pitch": 2e-3},
        "touch": ["depth", "wrench"],
        "frames": 2,
    }
    run = begin_run(training(features=features, dagger={"rounds": 1, "epochs": 1}), tmp_path / "run")
    train(run)
    path = tmp_path / "run/policy.onnx"
    model = onnx.load(path, load_external_data=False)
    assert path.stat().st_size <= MAX_BYTES
    assert not any(tensor.external_data for tensor in model.graph.initializer)
    policy = OnnxPolicy(path, environments_grid(), 2e-3)
    assert policy.spec.trained["training"]["features"]["frames"] == 2
    assert policy.spec.trained["steps"] == 9
    actor, session = new_actor(run), onnxruntime.InferenceSession(path)
    actor.load_state_dict(run.load_checkpoint()[1]["actor"])
    random = np.random.default_rng(3)
    for scale in (0.1, 1.0, 30.0):
        seen = {
            key: random.normal(0, scale, (1, *shape)).astype(np.float32) for key, shape in run.settings.shapes.items()
        }
        with torch.no_grad():
            wanted = actor(*(torch.from_numpy(seen[key]) for key in actor.keys)).numpy()
        (found,) = session.run(["action"], seen)
        assert np.abs(found - wanted).max() <= 1e-5
        assert np.abs(found).max() <= 1.0


def environments_grid() -> Any:
    from tacsim.models.sensor import CanonicalGrid

    return CanonicalGrid(rows=8, columns=8, pitch=1e-3, image_scale=1)


def test_normalise_by_examples_clips_far_values() -> None:
    layers = FeatureLayers({"touch": (2,), "goal": (1,)})
    assert layers.keys == ("goal", "touch")
    layers.normalise_by({"touch": torch.tensor([[1.0, 5.0], [3.0, 5.0]]), "goal": torch.tensor([[0.7], [0.7]])})
    found = layers(torch.tensor([[0.9]]), torch.tensor([[4.0, 1e9]]))
    # goal and the second number never varied: their own size; the first has mean 2 and deviation 1
    assert found[0].tolist() == pytest.approx([0.2, 2.0, MAX_DEVIATIONS])


def test_export_large_network_raises(tmp_path: Path) -> None:
    run = begin_run(training(), tmp_path / "run")
    with pytest.raises(ExportError, match="MiB, the maximum is 2 MiB"):
        export(PolicyNetwork(run.settings.shapes, 2, 1000), run.settings.spec, run.settings.shapes, tmp_path / "x.onnx")
    assert not (tmp_path / "x.onnx").exists()


def test_export_policy_without_checkpoint_raises(tmp_path: Path) -> None:
    run = begin_run(training(), tmp_path / "run")
    with pytest.raises(RunError, match="no round of its training is complete"):
        export_policy(run, tmp_path / "x.onnx")


def test_train_command_trains_exports_and_continues(tmp_path: Path) -> None:
    file = tmp_path / "short.yaml"
    file.write_text(json.dumps(training().model_dump(mode="json", exclude_none=True)), encoding="utf-8")
    run = tmp_path / "run"
    result = tacsim("train", str(file), "--set", "dagger.rounds=1", "--seed", "5", "--out", str(run))
    assert result.exit_code == 0, result.output
    assert "round 1: " in result.stdout
    assert RunFolder(run).settings.training.seed == 5
    result = tacsim("export", "policy", str(run), "--out", tmp_path / "x.onnx")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "x.onnx").read_bytes() == (run / "policy.onnx").read_bytes()
    result = tacsim("export", "policy", str(run), "--out", tmp_path / "x.onnx")
    assert result.exit_code == 2
    assert "exists already" in result.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "name a training file"),
        (("juggle",), "no training 'juggle'; allowed: "),
        (("squeeze", "--algorithm", "magic"), "algorithm"),
        (("squeeze", "--set", "dagger.round=3"), "did you mean"),
        (("squeeze", "--set", "overrides=[scene.presett=learn]"), "did you mean"),
        (("squeeze", "--set", "rig=mock", "--set", "overrides=[]", "--set", "randomise=null"), "not simulated"),
        (("squeeze", "--set", "features.flow=true"), "markers"),
        (("--resume", "nowhere"), "nowhere is not the folder of a training run"),
        (("--resume", "nowhere", "--seed", "1"), "omit other options"),
        (("squeeze", "--resume", "nowhere"), "omit other options"),
    ],
)
def test_train_command_invalid_input_is_reported(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = tacsim("train", *words)
    assert result.exit_code == 2, result.output
    assert said in " ".join(result.output.split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_train_bad_draw_is_reported_and_repeated(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touch_nothing_slippery(monkeypatch)
    told: list[str] = []
    drawn = {"draws": 12, "values": {"scene.friction.upper": {"choice": [0.4, 0.6]}}}
    run = begin_run(training(randomise=drawn, algorithm=algorithm), tmp_path / "run")
    assert train(run, warn=told.append).exists()
    assert told == ["drawn again: scene.friction.upper=0.6: nothing there"]
    assert sum(row["refused"] for row in run.load_checkpoint()[2]) >= 1


def test_train_many_bad_draws_raise_and_keep_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = begin_run(training(), tmp_path / "run")

    def none(*given: Any) -> Any:
        raise NoTouch("nothing there")

    def then_none(words: str, done: int, of: int) -> None:
        if "round 2" in words:
            monkeypatch.setattr("tacsim.sim.reset.SimReset.touch", none)

    with pytest.raises(BadDraws, match=r"8 draws in a row cannot begin .*nothing there"):
        train(run, then_none)
    assert run.load_checkpoint()[0] == 1
    monkeypatch.undo()
    assert export_policy(run, tmp_path / "kept.onnx") <= 1e-5
    monkeypatch.setattr("tacsim.sim.reset.SimReset.touch", none)
    result = tacsim("train", "--resume", str(run.folder))
    assert result.exit_code == 2 and "nothing there" in result.output, result.output
    assert f"tacsim export policy {run.folder}" in result.output.replace("\n", "")


@pytest.mark.parametrize(
    ("values", "error", "said"),
    [
        # the one draw can be: 2.7 mm, 3.1 mm high, 0.45; an end of its range cannot
        ({"task.goal": {"uniform": ["1 mm", "3.5 mm"]}},
         GoalOutOfReach, r"a limit: task.goal=3.5 mm: .*above the body"),
        ({"scene.body.geometry.size": {"uniform": [["3 mm", "3 mm", "1.5 mm"], ["3.5 mm", "3.5 mm", "4 mm"]]}},
         GoalOutOfReach, r"a limit: scene.body.geometry.size=\[3 mm, 3 mm, 1.5 mm\]: task.goal: 2 mm is above"),
        ({"scene.friction.upper": {"uniform": [-0.1, 0.6]}},
         ConfigError, r"(?s)friction.upper.*a limit: scene.friction"),
    ],
)  # fmt: skip
def test_begin_run_invalid_range_limit_raises(
    values: dict[str, Any], error: type[Exception], said: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=said):
        begin_run(training(randomise={"draws": 1, "seed": 3, "values": values}), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def other_format(folder: Path) -> None:
    text = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({**text, "format": FORMAT + 1}))


def cut_off(folder: Path) -> None:
    (folder / "checkpoint.pt").write_bytes((folder / "checkpoint.pt").read_bytes()[:500])


def other_checkpoint(folder: Path) -> None:
    torch.save({"format": 7}, folder / "checkpoint.pt")


def code(folder: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return os.system, (f"touch {folder}/ran",)

    torch.save({"format": FORMAT, "rounds": 1, "state": Evil(), "curve": []}, folder / "checkpoint.pt")


def misfit(folder: Path) -> None:
    text = json.loads((folder / "run.json").read_text())
    text["training"]["width"] = 9
    (folder / "run.json").write_text(json.dumps(text))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (other_format, f"has format {FORMAT + 1}, this version of tacsim continues format {FORMAT}"),
        (lambda folder: (folder / "run.json").write_text("{"), "run.json cannot be read"),
        (cut_off, "is not a checkpoint of this version"),
        (other_checkpoint, "has format 7"),
        (code, "is not a checkpoint of this version"),
        (misfit, "does not fit its settings"),
        (lambda folder: (folder / "round-000.npz").unlink(), "round-000.npz"),
        (lambda folder: (folder / "round-000.npz").write_bytes(b"PK"), "round-000.npz"),
    ],
)
def test_train_invalid_run_raises_with_reason(spoil: Any, said: str, done: Path, tmp_path: Path) -> None:
    import shutil

    folder = tmp_path / "run"
    shutil.copytree(done, folder)
    text = json.loads((folder / "run.json").read_text())
    text["training"]["dagger"]["rounds"] = 2
    (folder / "run.json").write_text(json.dumps(text))
    spoil(folder)
    result = tacsim("train", "--resume", str(folder))
    assert result.exit_code in (1, 2), result.output
    assert said in " ".join(result.output.split())
    assert "unexpected" not in result.output
    assert not (folder / "ran").exists()


def test_dagger_round_reports_loss_before_learning(tmp_path: Path) -> None:
    """A student whose steps of learning are nothing: the loss before a round is that of its last network."""
    run = begin_run(training(dagger={"rounds": 3, "epochs": 1, "rate": 1e-12}), tmp_path / "run")
    curve = []
    train(run, report_result=lambda figures: curve.append(dict(figures)))
    assert "unmet_loss" not in curve[0]  # in the first round the teacher acts
    met = [dict(np.load(run.folder / f"round-{number:03d}.npz")) for number in range(3)]
    actor = new_actor(run)
    actor.load_state_dict(run.load_checkpoint()[1]["actor"])
    for number in (1, 2):
        wanted = np.concatenate([each["action"] for each in met[: number + 1]])
        off = (infer_actions(actor, met[number]) - met[number]["action"]) / wanted.std(axis=0).clip(min=MIN_SPREAD)
        assert curve[number]["unmet_loss"] == pytest.approx(float(np.square(off).mean()), rel=1e-4)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one round."""
    folder: Path = tmp_path_factory.mktemp("done") / "run"
    train(begin_run(training(dagger={"rounds": 1, "epochs": 1}), folder))
    return folder


def test_torch_is_imported_only_by_train() -> None:
    program = """
import sys
import robot.cli, robot.open, robot.deploy.policy, robot.train.evaluate, robot.train.run_folder
from robot.cli.learn.evaluate import evaluate
from robot.cli.learn.train import export, train
assert not {"torch", "stable_baselines3", "onnx", "onnxruntime"} & set(sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment(), capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr


def test_make_environments_share_launches() -> None:
    envs = make_environments(training())
    assert envs.num_envs == 3
    assert [member.expert().tolist() for member in envs.members] == [[0.0, 0.0]] * 3  # nothing is running
    envs.reset(seed=1)
    assert all(np.abs(member.expert()).max() > 0.1 for member in envs.members)
    envs.close()
    assert isinstance(training(), Training)
