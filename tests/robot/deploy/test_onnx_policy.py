"""Learned policies: the same action on every rig, and nothing but an action from a file that is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode
from robot.deploy.onnx_policy import MAX_BYTES, OnnxPolicy
from robot.deploy.policy import PolicyNotFound, load_policy, require_fit
from robot.open import open_rig
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import IncompatibleRig, Needs
from tacsim.models.policy import ActionAxis, Features, MapGrid, PolicySpec
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import SqueezeConfig
from tacsim.tasks import make_task
from tests.tacsim.gym.small import SMALL, make

GRID = CanonicalGrid(rows=8, columns=8, pitch=1e-3, image_scale=1)  # of SMALL
FEATURES = Features(grid=MapGrid(rows=4, columns=4, pitch=2e-3), touch=("depth", "wrench"), frames=2)
TOUCH = 2 * (2 * 2 + 2 * 6)
AXES = (ActionAxis(arm="lower", direction=(0, 0, 1)), ActionAxis(arm="upper", direction=(0, 0, 1)))
WEIGHTS = np.random.default_rng(5).normal(0, 0.3, (TOUCH, 2)).astype(np.float32)


SPEC: dict[str, Any] = {
    "task": "squeeze",
    "period": 0.1,
    "features": FEATURES,
    "inputs": FeatureEncoder(FEATURES, GRID).inputs,
    "axes": AXES,
    "max_step": 0.2e-3,
}


def spec(**changed: Any) -> dict[str, Any]:
    return {**json.loads(PolicySpec(**SPEC).model_dump_json()), **changed}


def graph(
    last: str = "Tanh", maps: tuple[Any, ...] = (1, 4, 4, 4), touch: int = TOUCH, out: int = 2
) -> onnx.ModelProto:
    """action = last(touch . WEIGHTS + mean(maps) + goal)"""
    values = {"maps": maps, "touch": (1, touch), "goal": (1, 1)}
    inputs = [helper.make_tensor_value_info(key, TensorProto.FLOAT, shape) for key, shape in values.items()]
    nodes = [
        helper.make_node("Gemm", ["touch", "weights"], ["weighed"]),
        helper.make_node("ReduceMean", ["maps"], ["mean"], keepdims=0),
        helper.make_node("Add", ["weighed", "mean"], ["sum"]),
        helper.make_node("Add", ["sum", "goal"], ["all"]),
        helper.make_node(last, ["all"], ["action"]),
    ]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, (1, out))]
    made = helper.make_graph(nodes, "policy", inputs, outputs, [numpy_helper.from_array(WEIGHTS, "weights")])
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write_policy(model: onnx.ModelProto | None = None, metadata: Mapping[str, Any] | None = None) -> Path:
        model = graph() if model is None else model
        text = json.dumps(spec() if metadata is None else metadata)
        helper.set_model_props(model, {"tacsim.spec": text} if metadata != {} else {})
        (tmp_path / "policy.onnx").write_bytes(model.SerializeToString())
        return tmp_path / "policy.onnx"

    return write_policy


def read(path: Path) -> OnnxPolicy:
    return OnnxPolicy(path, GRID, 2e-3)


@pytest.mark.parametrize(("sight", "channels"), [("height", 4), ("picture", 12)])
def test_onnx_policy_on_rig_acts_as_in_environment(sight: Any, channels: int, write: Callable[..., Path]) -> None:
    """The same actions to the last bit, and so the same motion."""
    features = FEATURES.model_copy(update={"maps": (sight,)})
    said = {"features": features, "inputs": FeatureEncoder(features, GRID).inputs}
    path = write(graph(maps=(1, channels, 4, 4)), spec(**json.loads(PolicySpec(**{**SPEC, **said}).model_dump_json())))
    env, session = make(features=features, variants=()), onnxruntime.InferenceSession(path)
    with open_rig("sim", task="squeeze", overrides=SMALL) as rig:
        task = make_task(SqueezeConfig(kind="squeeze", goal=2e-3))
        policy = load_policy(str(path), task, rig.spec, GRID)
        require_fit(rig.name, rig.spec, policy, "learned", task)
        episode = run_episode(rig, policy, task, 3, setup=EpisodeSetup(seed=4))
        seen, _ = env.reset(seed=4)
        for step in episode.steps[1:]:
            inputs = {key: value.astype(float) for key, value in seen.items()}
            action = np.tanh(inputs["touch"] @ WEIGHTS + inputs["maps"].mean() + inputs["goal"])
            (same,) = session.run(["action"], {key: value[None] for key, value in seen.items()})
            assert same[0] == pytest.approx(action, abs=1e-6)  # NumPy's last digits are others
            seen, _, _, _, info = env.step(same[0])
            assert info["body_height"] == step.info["body_height"]
            for arm, state in env.rig.observe().arms.items():
                assert state.pose.position.tolist() == step.arms[arm].pose.position.tolist()
        moved = episode.steps[-1].arms["lower"].pose.position - episode.steps[0].arms["lower"].pose.position
        assert abs(moved[2]) > 1e-5


def test_onnx_policy_needs_follow_features(write: Callable[..., Path]) -> None:
    both = frozenset({"lower", "upper"})
    assert read(write()).needs == Needs(both, both, height=True)


def test_onnx_policy_held_back_arm_targets_from_its_pose(write: Callable[..., Path]) -> None:
    policy = read(write(metadata=spec(max_step=0.1e-3)))
    env = make(features=FEATURES, variants=())
    env.reset(seed=1)
    observation = env.rig.observe()
    asked = [policy(observation).tool["lower"] for _ in range(6)]  # it never reaches the target
    start = observation.arms["lower"].pose.position[2]
    away = [abs(float(pose.position[2] - start)) for pose in asked if pose is not None]
    assert len(away) == 6 and max(away) <= 3 * 0.1e-3
    policy.reset()
    again = policy(observation).tool["lower"]
    assert again is not None and asked[0] is not None
    assert again.position.tolist() == asked[0].position.tolist()


TASK = make_task(SqueezeConfig(kind="squeeze", goal=2e-3))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"period": 0.05}, r"a control period of 0.05 s, the rig has 0.1 s \(period\)"),
        ({"task": "reposition"}, "task 'reposition', this is 'squeeze'"),
        ({"axes": [{"arm": a, "direction": (1, 0, 0)} for a in ("lower", "upper")]}, "actions along lower"),
        ({"max_step": 0.5e-3}, r"steps of up to 0.5 mm, this task allows 0.2 mm \(max_step\)"),
    ],
)
def test_require_fit_other_rig_raises_with_difference(
    changed: dict[str, Any], words: str, write: Callable[..., Path]
) -> None:
    with open_rig("sim", task="squeeze", overrides=SMALL) as rig:
        policy = load_policy(str(write(metadata=spec(**changed))), TASK, rig.spec, GRID)
        with pytest.raises(IncompatibleRig, match=words):
            require_fit(rig.name, rig.spec, policy, "learned", TASK)


def test_load_policy_other_grid_or_no_task_raises(write: Callable[..., Path]) -> None:
    path = write()
    with pytest.raises(IncompatibleRig, match="cannot be put together"):
        OnnxPolicy(path, GRID.model_copy(update={"pitch": 0.3e-3}), 2e-3)
    with (
        open_rig("sim", task="squeeze", overrides=SMALL) as rig,
        pytest.raises(IncompatibleRig, match="there is no task"),
    ):
        require_fit(rig.name, rig.spec, load_policy(str(path), None, rig.spec, GRID), "learned", None)


def no_spec(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph(), {}


def unknown_operator(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph("Levitate"), spec()


def external_data(folder: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    model = graph()
    (folder / "weights.bin").write_bytes(WEIGHTS.tobytes())
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", str(folder / "weights.bin")
    return model, spec()


def external_data_here(folder: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    """In the current folder, where onnxruntime looks for the weights of what it reads from memory."""
    model, said = external_data(folder)
    model.graph.initializer[0].external_data[0].value = "weights.bin"
    return model, said


def other_version(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph(), spec(version=2)


def no_json(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph(), spec(period="soon")


def other_inputs(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph(), spec(features={**spec()["features"], "goal": False})


def other_scale(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    wrong = spec()
    wrong["inputs"]["touch"]["scales"][0] = 1.0
    return graph(), wrong


def misshapen_input(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph(maps=(1, 3, 4, 4)), spec()


def other_rows(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph(maps=(1, 4, 7, 4)), spec()


def many_at_once(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph(maps=(3, 4, 4, 4)), spec()


def misshapen_action(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    return graph(out=2), spec(axes=spec()["axes"][:1])


def action_of_texts(_: Path) -> tuple[onnx.ModelProto, Mapping[str, Any]]:
    model = graph()
    model.graph.node[-1].CopyFrom(helper.make_node("Cast", ["all"], ["action"], to=TensorProto.STRING))
    model.graph.output[0].type.tensor_type.elem_type = TensorProto.STRING
    return model, spec()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (no_spec, "does not describe its inputs: it has no metadata 'tacsim.spec'"),
        (unknown_operator, "not an ONNX file that can run here: .*Levitate"),
        (external_data, "not an ONNX file that can run here: .*[Ee]xternal"),
        (external_data_here, "not an ONNX file that can run here: .*[Ee]xternal"),
        (other_version, "metadata 'tacsim.spec' cannot be read: version: Input should be 1"),
        (no_json, "cannot be read: period"),
        (other_inputs, "its graph takes goal, maps, touch, its metadata list maps, touch"),
        (other_scale, "its training had another input 'touch' than this version"),
        (misshapen_input, r"its input 'maps' is tensor.float. \[1, 3, 4, 4\]; wanted: .* 1 x 4 x 4 x 4"),
        (other_rows, r"its input 'maps' is tensor.float. \[1, 4, 7, 4\]; wanted: .* 1 x 4 x 4 x 4"),
        (many_at_once, r"its input 'maps' is tensor.float. \[3, 4, 4, 4\]; wanted: .* 1 x 4 x 4 x 4"),
        (misshapen_action, "it must give 'action', tensor.float. 1 x 1"),
        (action_of_texts, "it must give 'action', tensor.float. 1 x 2; it gives .*string"),
    ],
)
def test_onnx_policy_invalid_file_raises_with_reason(
    wrong: Any, words: str, write: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PolicyNotFound, match=f"(?s){words}") as caught:
        read(write(*wrong(tmp_path)))
    assert "\n" not in str(caught.value)


def test_onnx_policy_goal_of_other_task_is_named(write: Callable[..., Path]) -> None:
    with pytest.raises(PolicyNotFound, match=r"was trained for task 'squeeze', whose goal is .* 1 x 2"):
        OnnxPolicy(write(), GRID, (1e-3, 2e-3))


def test_onnx_policy_unreadable_file_raises(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    with pytest.raises(PolicyNotFound, match="cannot be read: No such file"):
        read(path)
    for content in (b"", b"\x00" * 100, graph().SerializeToString()[:200]):
        path.write_bytes(content)
        with pytest.raises(PolicyNotFound, match=r"not an ONNX file that can run here|does not describe its inputs"):
            read(path)
    with path.open("wb") as file:
        file.truncate(2**30)
    with pytest.raises(PolicyNotFound, match=rf"has 1,024 MiB, the maximum is {MAX_BYTES >> 20} MiB"):
        read(path)
    with pytest.raises(PolicyNotFound, match="cannot be read"):
        read(tmp_path)  # a folder


def test_onnx_policy_without_onnxruntime_names_package(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    with pytest.raises(PolicyNotFound, match=r"pip install 'tacsim\[policy\]'"):
        read(write())


@pytest.mark.parametrize(("last", "words"), [("Acosh", "gives .*nan"), ("Exp", r"gives .*within \[-1, 1\]")])
def test_onnx_policy_invalid_action_stops_arms(last: str, words: str, write: Callable[..., Path]) -> None:
    path = write(graph(last), spec())
    with open_rig("sim", task="squeeze", overrides=SMALL) as rig:
        policy = load_policy(str(path), TASK, rig.spec, GRID)
        with pytest.raises(
            EpisodeFailed, match=f"after 0 of 3 steps: .*PolicyFailed: policy 'policy.onnx' {words}"
        ) as failed:
            run_episode(rig, policy, TASK, 3)
        assert len(failed.value.episode.steps) == 1


def test_onnx_policy_nan_observation_raises(write: Callable[..., Path]) -> None:
    from dataclasses import replace

    policy = read(write())
    env = make(features=FEATURES, variants=())
    env.reset(seed=1)
    seen = env.rig.observe()
    wrench = np.full(6, np.nan)
    arms = {**seen.arms, "upper": replace(seen.arms["upper"], wrench=wrench)}
    with pytest.raises(RuntimeError, match="touch has values that are not finite"):
        policy(replace(seen, arms=arms))


def test_onnx_policy_metadata_round_trip_is_equal(write: Callable[..., Path]) -> None:
    made = spec(trained={"seed": 3, "by": "a test"})
    assert json.loads(read(write(metadata=made)).spec.model_dump_json()) == made
