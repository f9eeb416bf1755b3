"""Teacher to student: a policy that acts by the truth shows one that only feels what to do (DAgger, Ross et al. 2011).

In each round the student acts, the first time the teacher; what the teacher would have done is learned in all states that were
met. A round is a function of the seed, its number and the network, so a run that was killed goes on to the same end.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from robot.train.network import PolicyNetwork

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class DaggerSettings:
    """How long, and how."""

    rounds: int = 8
    steps: int = 200  # of each environment in a round
    epochs: int = 20  # of learning after each round
    batch: int = 256
    rate: float = 1e-3  # of Adam
    seed: int = 0


def train(
    envs: VectorEnv[Any, Any, Any],
    settings: DaggerSettings,
    folder: Path,
    tell: Callable[[str, int, int], None] = lambda words, done, of: None,
) -> PolicyNetwork:
    """Trains a student in `envs` (of TacsimEnv, SAME_STEP), and keeps it in `folder` after each round; goes on where a run
    in that folder ended.

    tell: is told what is done, and how much of how much.
    Raises ValueError for a folder of other settings.
    """
    space = envs.single_observation_space
    shapes = {key: space[key].shape for key in space}  # type: ignore[index, attr-defined]
    torch.manual_seed(settings.seed)
    network = PolicyNetwork(shapes, int(envs.single_action_space.shape[0]))  # type: ignore[index]
    first = _resume(network, settings, folder)
    for number in range(first, settings.rounds):
        seen, wanted = _collect(envs, None if number == 0 else network, settings, number, tell)
        _save(folder / f"round-{number:03d}.npz", lambda file: np.savez(file, action=wanted, **seen))
        data, actions = _rounds(folder, number)
        _learn(network, data, actions, settings, number, tell)
        checkpoint = {"round": number + 1, "network": network.state_dict()}
        _save(folder / "checkpoint.pt", lambda file: torch.save(checkpoint, file))
    return network


def act(network: PolicyNetwork, seen: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """Actions (n, k) for a batch of features."""
    with torch.no_grad():
        found: NDArray[np.float32] = network(*(torch.from_numpy(np.asarray(seen[key])) for key in network.keys)).numpy()
    return found


def _collect(
    envs: VectorEnv[Any, Any, Any],
    student: PolicyNetwork | None,
    settings: DaggerSettings,
    number: int,
    tell: Callable[[str, int, int], None],
) -> tuple[Arrays, NDArray[np.float32]]:
    """What was seen (n, ...), and what the teacher would have done (n, k). Without a student the teacher acts, with noise
    that leads it off its way."""
    random = np.random.default_rng([settings.seed, number])
    seen, _ = envs.reset(seed=int(random.integers(2**31)))
    states: list[Arrays] = []
    labels: list[NDArray[np.float32]] = []
    for step in range(settings.steps):
        tell(f"round {number + 1} of {settings.rounds}: acting", step, settings.steps)
        teacher = np.stack(envs.call("expert")).astype(np.float32)  # type: ignore[attr-defined]
        states.append({key: value.copy() for key, value in seen.items()})
        labels.append(teacher)
        if student is None:
            action = teacher + random.normal(0.0, 0.3, teacher.shape).astype(np.float32)
        else:
            action = act(student, seen)
        seen, *_ = envs.step(action.clip(-1.0, 1.0))
    return {key: np.concatenate([state[key] for state in states]) for key in states[0]}, np.concatenate(labels)


def _learn(
    network: PolicyNetwork,
    data: Arrays,
    actions: NDArray[np.float32],
    settings: DaggerSettings,
    number: int,
    tell: Callable[[str, int, int], None],
) -> None:
    tensors = {key: torch.from_numpy(value) for key, value in data.items()}
    wanted = torch.from_numpy(actions)
    if number == 0:
        network.normalise_by(tensors)
    random = torch.Generator().manual_seed(settings.seed * 1000 + number)
    optimiser = torch.optim.Adam(network.parameters(), lr=settings.rate)
    for epoch in range(settings.epochs):
        tell(f"round {number + 1} of {settings.rounds}: learning", epoch, settings.epochs)
        for part in torch.randperm(len(wanted), generator=random).split(settings.batch):
            loss = torch.mean((network(*(tensors[key][part] for key in network.keys)) - wanted[part]) ** 2)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()


def _rounds(folder: Path, last: int) -> tuple[Arrays, NDArray[np.float32]]:
    """All that was met until round `last`."""
    parts = []
    for number in range(last + 1):
        with np.load(folder / f"round-{number:03d}.npz", allow_pickle=False) as file:
            parts.append({key: file[key] for key in file.files})
    whole = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return whole, whole.pop("action")


def _resume(network: PolicyNetwork, settings: DaggerSettings, folder: Path) -> int:
    """The number of the next round."""
    told = folder / "dagger.json"
    mine = json.dumps(asdict(settings), indent=2)
    if not told.exists():
        folder.mkdir(parents=True, exist_ok=True)
        _save(told, lambda file: file.write(mine.encode()))
    elif {**json.loads(told.read_text()), "rounds": 0} != {**json.loads(mine), "rounds": 0}:
        raise ValueError(f"{folder} holds a run with other settings ({told.name}): name another folder")
    checkpoint = folder / "checkpoint.pt"
    if not checkpoint.exists():
        return 0
    found = torch.load(checkpoint, weights_only=True)  # tensors and numbers, no code
    network.load_state_dict(found["network"])
    return int(found["round"])


def _save(path: Path, write: Callable[[Any], Any]) -> None:
    """There is a whole file or none, whenever the process ends."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        write(file)
    part.replace(path)
