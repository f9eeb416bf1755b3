"""Trains a student, which has only sensor features, on the actions of a teacher, which has the truth (DAgger, Ross et
al. 2011).

In each round the student acts; in the first round the teacher. The student learns the actions of the teacher in all
states visited so far.
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
from robot.rig.sharded_env import Environments
from robot.train.network import PolicyNetwork
from robot.train.run_folder import ReportProgress, RunError
from tacsim.models.policy import Training
from tacsim.models.text import printable_line

MIN_SPREAD = 0.02  # of the actions of an axis; a smaller spread is replaced by it
Arrays = dict[str, NDArray[Any]]


class Dagger:
    """Trains a student in `envs`. Visited states are stored in `folder`, one file per round."""

    def __init__(self, envs: Environments, training: Training, actor: PolicyNetwork, folder: Path) -> None:
        self._envs, self._settings, self._folder = envs, training.dagger, folder
        self._seed, self.actor = training.seed, actor
        self.rounds = training.dagger.rounds

    def round(self, number: int, report_progress: ReportProgress) -> dict[str, float]:
        """Acts, stores the visited states, and learns."""
        features, labels, figures = self._collect(number, report_progress)
        write_whole(
            self._folder / f"round-{number:03d}.npz",
            lambda file: np.savez(file, allow_pickle=False, action=labels, **features),
        )
        losses = self._learn(*_load_states(self._folder, number), number, len(labels), report_progress)
        return {"steps": float(len(labels)), **figures, **losses}

    def state(self) -> dict[str, Any]:
        return {"actor": self.actor.state_dict()}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.actor.load_state_dict(state["actor"])

    def _collect(
        self, number: int, report_progress: ReportProgress
    ) -> tuple[Arrays, NDArray[np.float32], dict[str, float]]:
        """Features (n, ...), actions of the teacher in these states (n, k), and mean figures of the episodes. In the
        first round the teacher acts, with noise so that it visits more states."""
        envs = self._envs
        random = np.random.default_rng([self._seed, number])
        features, _ = envs.reset(seed=int(random.integers(2**31)))
        steps = envs.get_attr("task")[0].config.steps
        states: list[Arrays] = []
        labels: list[NDArray[np.float32]] = []
        ends: list[NDArray[np.float64]] = []
        for step in range(steps):
            report_progress(f"round {number + 1} of {self.rounds}: acting", step, steps)
            shown = envs.call("expert", self._settings.teacher == "truth")
            teacher = self._settings.pace * np.stack(shown).astype(np.float32)
            states.append({key: value.copy() for key, value in features.items()})
            labels.append(teacher)
            if number == 0:
                action = teacher + random.normal(0.0, self._settings.noise, teacher.shape).astype(np.float32)
            else:
                action = infer_actions(self.actor, features)
            features, _, _, _, info = envs.step(action.clip(-1.0, 1.0))
            ends.append(episode_ends(info))
        data = {key: np.concatenate([state[key] for state in states]) for key in states[0]}
        return data, np.concatenate(labels), mean_figures(ends)

    def _learn(
        self, data: Arrays, actions: NDArray[np.float32], number: int, new: int, report_progress: ReportProgress
    ) -> dict[str, float]:
        """Learns, and returns the mean loss of the last epoch; except in the first round also the loss of the `new`
        states, which come last, before learning: a much larger one indicates overfitting to the earlier states."""
        settings = self._settings
        tensors = {key: torch.from_numpy(value) for key, value in data.items()}
        labels = torch.from_numpy(actions)
        if number == 0:
            self.actor.layers.normalise_by(tensors)
        spread = labels.std(dim=0, unbiased=False).clamp(min=MIN_SPREAD)  # small and large steps have equal weight
        losses: dict[str, float] = {}
        if number:
            answers = infer_actions(self.actor, {key: value[-new:] for key, value in data.items()})
            losses["unmet_loss"] = float(np.square((answers - actions[-new:]) / spread.numpy()).mean())
        random = torch.Generator().manual_seed(self._seed * 1000 + number)
        optimiser = torch.optim.Adam(self.actor.parameters(), lr=settings.rate)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs)
        total = 0.0
        for epoch in range(settings.epochs):
            report_progress(f"round {number + 1} of {self.rounds}: learning", epoch, settings.epochs)
            total = 0.0
            for part in torch.randperm(len(labels), generator=random).split(settings.batch):
                answer = self.actor(*(tensors[key][part] for key in self.actor.keys))
                loss = torch.mean(((answer - labels[part]) / spread) ** 2)
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                total += loss.item() * len(part)
            decay.step()
        return losses | {"loss": total / len(labels)}


def infer_actions(actor: torch.nn.Module, features: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """Computes actions (n, k) for a batch of features."""
    with torch.no_grad():
        found: NDArray[np.float32] = actor(*(torch.from_numpy(np.asarray(features[key])) for key in actor.keys)).numpy()
    return found


def episode_ends(info: Mapping[str, Any]) -> NDArray[np.float64]:
    """(n, 3) of the episodes that ended in a step of a vector environment in SAME_STEP: distance [m], success, peak
    force [N]."""
    if "final_info" not in info:
        return np.empty((0, 3))
    last = info["final_info"]
    figures = [last[key][info["_final_info"]] for key in ("distance", "is_success", "peak_force")]
    return np.stack(figures, axis=1).astype(np.float64)


def mean_figures(ends: Sequence[NDArray[np.float64]]) -> dict[str, float]:
    """Means over all episodes of `episode_ends`."""
    distance, success, force = np.concatenate(ends).mean(axis=0)
    return {"distance": float(distance), "success": float(success), "peak_force": float(force)}


def _load_states(folder: Path, last: int) -> tuple[Arrays, NDArray[np.float32]]:
    """Loads the visited states and labels of the rounds up to `last`. Raises RunError."""
    parts = []
    for number in range(last + 1):
        path = folder / f"round-{number:03d}.npz"
        try:
            with np.load(path, allow_pickle=False) as file:
                parts.append({key: file[key] for key in file.files})
        except (ValueError, EOFError, BadZipFile) as failure:
            raise RunError(f"{path} cannot be read: {printable_line(str(failure))}; start a new training") from None
    whole = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return whole, whole.pop("action")
