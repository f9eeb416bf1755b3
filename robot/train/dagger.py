"""Teacher to student: a policy that acts by the truth shows one that only feels what to do (DAgger, Ross et al. 2011).

In each round the student acts, the first time the teacher; what the teacher would have done is learned in all states
that were met so far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from numpy.typing import NDArray

from robot.common.whole_file import write_whole
from robot.train.network import PolicyNetwork
from robot.train.run_folder import RunError, Tell
from tacsim.gym.vector import TacsimVectorEnv
from tacsim.models.text import printable_line
from tacsim.models.training import Training

LEAST_SPREAD = 0.02  # of an axis's actions: less of it is not learned more exactly
Arrays = dict[str, NDArray[Any]]


class Dagger:
    """A student in `envs`. What was met is kept in `folder`, a file a round."""

    def __init__(self, envs: TacsimVectorEnv, training: Training, actor: PolicyNetwork, folder: Path) -> None:
        self._envs, self._settings, self._folder = envs, training.dagger, folder
        self._seed, self.actor = training.seed, actor
        self.rounds = training.dagger.rounds

    def round(self, number: int, tell: Tell) -> dict[str, float]:
        """Acts, keeps what was met, and learns."""
        seen, wanted, figures = self._collect(number, tell)
        write_whole(
            self._folder / f"round-{number:03d}.npz",
            lambda file: np.savez(file, allow_pickle=False, action=wanted, **seen),
        )
        losses = self._learn(*_all_met(self._folder, number), number, len(wanted), tell)
        return {"steps": float(len(wanted)), **figures, **losses}

    def state(self) -> dict[str, Any]:
        return {"actor": self.actor.state_dict()}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.actor.load_state_dict(state["actor"])

    def _collect(self, number: int, tell: Tell) -> tuple[Arrays, NDArray[np.float32], dict[str, float]]:
        """What was seen (n, ...), what the teacher would have done (n, k), and how the episodes went. In the first
        round the teacher acts, with noise that leads it off its way."""
        envs = self._envs
        random = np.random.default_rng([self._seed, number])
        seen, _ = envs.reset(seed=int(random.integers(2**31)))
        steps = envs.members[0].task.config.steps
        states: list[Arrays] = []
        labels: list[NDArray[np.float32]] = []
        ends: list[NDArray[np.float64]] = []
        for step in range(steps):
            tell(f"round {number + 1} of {self.rounds}: acting", step, steps)
            teacher = self._settings.pace * np.stack([member.expert() for member in envs.members])
            states.append({key: value.copy() for key, value in seen.items()})
            labels.append(teacher)
            if number == 0:
                action = teacher + random.normal(0.0, self._settings.noise, teacher.shape).astype(np.float32)
            else:
                action = act(self.actor, seen)
            seen, _, _, _, info = envs.step(action.clip(-1.0, 1.0))
            ends.append(ended(info))
        data = {key: np.concatenate([state[key] for state in states]) for key in states[0]}
        return data, np.concatenate(labels), means(ends)

    def _learn(self, data: Arrays, actions: NDArray[np.float32], number: int, new: int, tell: Tell) -> dict[str, float]:
        """The mean loss of the last epoch; before it, but for the first round, that of the `new` states, which come
        last: one far greater says that the student knows by heart what it has met."""
        settings = self._settings
        tensors = {key: torch.from_numpy(value) for key, value in data.items()}
        wanted = torch.from_numpy(actions)
        if number == 0:
            self.actor.layers.normalise_by(tensors)
        spread = wanted.std(dim=0, unbiased=False).clamp(min=LEAST_SPREAD)  # small steps count as much as large ones
        losses: dict[str, float] = {}
        if number:
            answers = act(self.actor, {key: value[-new:] for key, value in data.items()})
            losses["unmet_loss"] = float(np.square((answers - actions[-new:]) / spread.numpy()).mean())
        random = torch.Generator().manual_seed(self._seed * 1000 + number)
        optimiser = torch.optim.Adam(self.actor.parameters(), lr=settings.rate)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs)
        total = 0.0
        for epoch in range(settings.epochs):
            tell(f"round {number + 1} of {self.rounds}: learning", epoch, settings.epochs)
            total = 0.0
            for part in torch.randperm(len(wanted), generator=random).split(settings.batch):
                answer = self.actor(*(tensors[key][part] for key in self.actor.keys))
                loss = torch.mean(((answer - wanted[part]) / spread) ** 2)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                total += loss.item() * len(part)
            decay.step()
        return losses | {"loss": total / len(wanted)}


def act(actor: torch.nn.Module, seen: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """Actions (n, k) for a batch of features."""
    with torch.no_grad():
        found: NDArray[np.float32] = actor(*(torch.from_numpy(np.asarray(seen[key])) for key in actor.keys)).numpy()
    return found


def ended(info: Mapping[str, Any]) -> NDArray[np.float64]:
    """(n, 3) of the episodes that ended in a step of a vector environment in SAME_STEP: distance [m], success, peak
    force [N]."""
    if "final_info" not in info:
        return np.empty((0, 3))
    last = info["final_info"]
    figures = [last[key][info["_final_info"]] for key in ("distance", "is_success", "peak_force")]
    return np.stack(figures, axis=1).astype(np.float64)


def means(ends: Sequence[NDArray[np.float64]]) -> dict[str, float]:
    """Of all episodes that `ended`."""
    distance, success, force = np.concatenate(ends).mean(axis=0)
    return {"distance": float(distance), "success": float(success), "peak_force": float(force)}


def _all_met(folder: Path, last: int) -> tuple[Arrays, NDArray[np.float32]]:
    """What was met until round `last`."""
    parts = []
    for number in range(last + 1):
        path = folder / f"round-{number:03d}.npz"
        try:
            with np.load(path, allow_pickle=False) as file:
                parts.append({key: file[key] for key in file.files})
        except (ValueError, EOFError, BadZipFile) as failure:
            raise RunError(f"{path} cannot be read: {printable_line(str(failure))}; train anew") from None
    whole = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return whole, whole.pop("action")
