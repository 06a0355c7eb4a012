"""OnlineTrainer: a policy, its environment, and demonstrations; in rounds, between which it can be stopped."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.record.loggers import Logger

from lw_torchrl._checks import check_choice, checked_but
from lw_torchrl._devices import CPU, drawn_on
from lw_torchrl._progress import Progress
from lw_torchrl._state_tree import check_like
from lw_torchrl._versions import LIBRARIES, SIMULATORS
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.data.rewards import REWARDS
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.tasks import Task, named_tasks
from lw_torchrl.modules.critics import QValue
from lw_torchrl.modules.policy import Policy
from lw_torchrl.training.advantage_learner import AdvantageLearner
from lw_torchrl.training.checkpoint import describe_data, describe_learning, write
from lw_torchrl.training.expert_iteration import ExpertIterationLearner
from lw_torchrl.training.exploration import Exploration, longest_standstill
from lw_torchrl.training.first_episodes import FirstEpisodes
from lw_torchrl.training.growing_replay import check_growing_replay
from lw_torchrl.training.interrupts import Interrupt, interrupts_between_steps
from lw_torchrl.training.learner import Learner
from lw_torchrl.training.minibatches import check_minibatches, verify_rows
from lw_torchrl.training.off_policy import ResidualLearner, SACLearner, TD3Learner
from lw_torchrl.training.on_policy import PPOLearner
from lw_torchrl.training.online_config import OnlineConfig
from lw_torchrl.training.policy_checks import check_can_be_saved, check_trained
from lw_torchrl.training.training_state import OneWriter, check_description, load_training, misfit

LEARNERS: dict[str, type[Learner]] = {
    "advantage": AdvantageLearner,
    "td3": TD3Learner,
    "sac": SACLearner,
    "residual": ResidualLearner,
    "ppo": PPOLearner,
    "expert-iteration": ExpertIterationLearner,
}
"""The methods of ``lw-torchrl online``, by name."""


class OnlineTrainer:
    """Trains a policy in its environment, beside demonstrations.

    It goes on in rounds. In one each row of the environment runs episodes, which end at their first success or after
    ``max_steps``; what comes goes into the buffer, and the learner makes its gradient steps. At its end all rows are
    reset, since an episode's physics cannot be restored, and a checkpoint is written: training that is stopped, in
    whatever way, goes on from the last round's end with the same bits.

    Args:
        actor: the policy to begin with, one that was cloned, say. Methods "td3" and "expert-iteration" train it in
            place, and so does "residual" a :class:`ResidualActor`, of some steps of a plan say; the others train one
            that is made of it, ``policy``.
        replay: demonstrations that grow: ``LanguageWorldExperienceReplay(..., grow=, label="executed",
            terminate_on_success=True, sampler=CoLearningSampler("grown"))`` with the actor's transform. Its reward is
            what is learned from. Its generator is set to the configuration's seed.
        config: how to train.
        method: "td3", "sac" or "residual", from demonstrations and what came, half of a minibatch each; "ppo"; or
            "expert-iteration", behavioral cloning of demonstrations and own successes. See :data:`LEARNERS`.
        tasks: to run, as for :class:`LanguageWorldEnv`; None for those of the demonstrations.
        critic: whose copies are trained by "td3", "sac" and "residual", with its normalisation as it is
            (``critic.fit_normalization``); None for one that sees what the actor sees, by the actor's.
        checkpoint: a file to write checkpoints to, the buffer's rows among it. If it is there already, training
            carries on from it.
        logger: a TorchRL logger, for what ``history`` holds, by steps of the environment.
        progress: show a progress bar.
        num_threads: of the simulation, which changes no result.

    Attributes:
        policy: what is trained.
        frames: steps of the environment done, up to the last round's end.
        history: of each round, "frames", "episodes" (those that ended), the means of losses and values, and "success",
            that of the first episode of each row, which has the time to end; not of a round shorter than an episode.

    Warns:
        UserWarning: the checkpoint was written under another version of torch or another package that bits hang on: it
            goes on, but not bit for bit.

    Raises:
        ValueError: a wrong method; a buffer that does not grow, or is not of these plans; the checkpoint is damaged, or
            of another architecture, start, configuration or data; or, in :meth:`train`, a loss is no number.
        TypeError: the actor is no :class:`Policy`, or none that the method can train.
        OSError: the checkpoint cannot be written; the earlier one stays.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> plans = lw.load_plans("MT10")
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     replay = lw.LanguageWorldExperienceReplay(
        ...         root + "/demos",
        ...         label="executed",
        ...         reward="dense_cost",
        ...         terminate_on_success=True,
        ...         n_steps=5,
        ...         gamma=0.99,
        ...         grow=1_000,
        ...         sampler=lw.CoLearningSampler("grown"),
        ...         transform=lw.QAFTransform(plans),
        ...     )
        ...     config = lw.OnlineConfig(frames=40, rows=4, round_steps=5, max_steps=5, first_frames=20, batch_size=8)
        ...     trainer = lw.OnlineTrainer(lw.PlanConditionedActor(plans), replay, config, progress=False)
        ...     trainer.train()
        >>> [one["frames"] for one in trainer.history]
        [20, 40]

    Source: Ball et al., 'Efficient Online Reinforcement Learning with Offline Data'; Anthony et al., 'Thinking Fast and
    Slow with Deep Learning and Tree Search', for expert iteration.
    """

    @checked_but("critic")
    def __init__(
        self,
        actor: Policy,
        replay: LanguageWorldExperienceReplay,
        config: OnlineConfig | None = None,
        *,
        method: str = "td3",
        tasks: str | Task | Iterable[str | Task] | None = None,
        critic: QValue | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
        logger: Logger | None = None,
        progress: bool = True,
        num_threads: int | None = None,
    ) -> None:
        self.config = config = config or OnlineConfig()
        self.method = check_choice("method", method, LEARNERS)
        check_can_be_saved(actor)
        check_growing_replay(actor, replay, config)
        if critic is not None:
            check_minibatches([critic], replay, config.batch_size)
        self.replay, self.logger, self.progress = replay, logger, progress
        self.tasks = replay.tasks if tasks is None else list(named_tasks(tasks).values())
        self.num_threads = num_threads
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self._writer = OneWriter(self.checkpoint)
        generator = torch.Generator().manual_seed(config.seed)
        replay.set_rng(generator)
        self._drawn = generator.get_state()
        start = _fingerprint(actor)
        with drawn_on(CPU, self._drawn):
            self.learner = LEARNERS[method](actor, replay, config, critic)
            self._drawn = torch.get_rng_state()
        self.policy = self.learner.policy
        self._patience = longest_standstill(replay[: len(replay) - replay.storage.num_grown])
        self.history: list[dict[str, float]] = []
        self.round = 0
        self._episodes: Tensor | None = None
        if self.checkpoint is not None:
            self._described = {
                "actor": self.policy.describe(),
                "start": {"weights": start},
                "critic": {} if critic is None else {"weights": _fingerprint(critic)},
                "online": {"method": method, "tasks": list(named_tasks(self.tasks)), **asdict(config)},
                "data": describe_data(replay),
                "replay": describe_learning(replay),
            }
            if self.checkpoint.exists():
                verify_rows(replay)
                check_description(self.checkpoint, self._described)
                weights = self.policy.state_dict(keep_vars=True)
                packages = (*SIMULATORS, *LIBRARIES)
                self._load(load_training(self.checkpoint, self.policy, weights, packages))

    @property
    def frames(self) -> int:
        return min(self.round * self.config.round_steps * self.config.rows, self.config.frames)

    def save(self) -> None:
        """Write the checkpoint, if there is to be one; an earlier one is replaced whole.

        Raises:
            ValueError: the weights are no finite numbers.
        """
        check_trained(dict(self.policy.named_parameters()), self.learner.made)
        if self.checkpoint is not None:
            write(self.checkpoint, self._described, self.policy, self.policy.state_dict(), self._state())
            self._writer.know()

    def _state(self) -> dict[str, Any]:
        return {
            "round": self.round,
            "drawn": self._drawn.clone(),
            "episodes": self._episodes,
            "history": self.history,
            "learner": self.learner.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def _load(self, found: dict[str, Any]) -> None:
        assert self.checkpoint is not None
        try:
            check_like({**found, **_UNLIKE}, {**self._state(), **_UNLIKE}, "state")
            if not 0 < found["round"] <= self.config.rounds:
                raise ValueError(f"round must be from 1 to {self.config.rounds}, got {found['round']}")
            torch.Generator().set_state(found["drawn"].clone())
            self.learner.load_state_dict(found["learner"])
            self.replay.load_state_dict(found["replay"])
            self._episodes, self._drawn = found["episodes"].clone(), found["drawn"].clone()
            self.history = [{str(name): _number(value) for name, value in one.items()} for one in found["history"]]
            self.round = found["round"]
        except (ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
            raise misfit(self.checkpoint, error) from error

    def train(self) -> None:
        """Train to the last step of the environment, from the last round's end.

        Ctrl-C ends it between two steps, and what came since the last round's end is lost; a second Ctrl-C at once.

        Raises:
            ValueError: a loss, or a weight, is no number.
        """
        bar = Progress(f"training {self.method}", self.config.frames, "step", initial=self.frames, show=self.progress)
        base = LanguageWorldEnv(
            self.tasks,
            num_envs=self.config.rows,
            seed=self.config.seed,
            reward=REWARDS[self.replay.reward].source,
            max_steps=self.config.max_steps,
            terminate_on_success=True,
            num_threads=self.num_threads,
        )
        transform = self.policy.transform()
        env = base if transform is None else TransformedEnv(base, transform)
        try:
            with self._writer.alone(), bar, interrupts_between_steps() as interrupt:
                if self._episodes is not None:
                    base.set_extra_state(self._episodes)
                while self.round < self.config.rounds and not interrupt.asked:
                    with drawn_on(CPU, self._drawn):
                        done = self._run_round(env, bar, interrupt)
                        drawn = torch.get_rng_state()
                    if done is None:
                        break
                    self._drawn, self._episodes = drawn, base.get_extra_state()
                    self.round += 1
                    self._log(done)
                    self.save()
        finally:
            env.close()

    def _run_round(self, env: EnvBase, bar: Progress, interrupt: Interrupt) -> dict[str, float] | None:
        """Do a round; what to log of it, or None where it was interrupted."""
        config, learner = self.config, self.learner
        state, done_before = env.reset(), self.frames
        first = FirstEpisodes(config.rows)
        exploration = Exploration(config, self._patience) if learner.noisy else None
        came = []
        steps = min(config.round_steps, config.steps - self.round * config.round_steps)
        due = 0
        for begin in range(0, steps, config.exploration_hold):
            if interrupt.asked:
                return None
            if exploration is not None:
                exploration.draw()
            chunk = []
            for _ in range(min(config.exploration_hold, steps - begin)):
                with torch.no_grad():
                    state = learner.act(state)
                if exploration is not None:
                    explored = state.get("action") + learner.noise_weight(state) * exploration.noise(state)
                    state.set("action", explored.clamp(-1.0, 1.0))
                state.set(("collector", "traj_ids"), first.ids(self.round))
                step, state = env.step_and_maybe_reset(state)
                first.note(step)
                if exploration is not None:
                    exploration.note(step.get(("next", "done")).squeeze(-1))
                chunk.append(step)
            rows = torch.stack(chunk, 1)
            learner.observe(rows)
            if learner.wants_round:
                came.append(rows)
            frames = done_before + (begin + len(chunk)) * config.rows
            steps_due = self._due(frames) - self._due(frames - rows.numel())
            learner.learn(steps_due)
            due += steps_due
            bar.update(rows.numel())
        learner.end_round(torch.cat(came, 1) if came else None, due)
        return {"frames": done_before + steps * config.rows, **first.result(), **learner.told()}

    def _due(self, frames: int) -> int:
        """The gradient steps that are to be made in the first so many steps of the environment."""
        return int(max(0, frames - self.config.first_frames) * self.config.utd)

    def _log(self, found: dict[str, float]) -> None:
        for name, value in found.items():
            if name.startswith("loss") and value != value:
                raise ValueError(f"{name} is no number in round {self.round}: the learning rate is too high")
        self.history.append(found)
        if self.logger is not None:
            for name, value in found.items():
                if name != "frames":
                    self.logger.log_scalar(f"train/{name}", value, step=int(found["frames"]))


_UNLIKE = {"replay": None, "history": None, "learner": None, "episodes": None}


def _number(value: Any) -> int | float:
    """A number as it was written: an integer stays one."""
    return value if type(value) is int else float(value)


def _fingerprint(module: torch.nn.Module) -> str:
    """Of the weights."""
    found = sha256()
    for name, tensor in sorted(module.state_dict().items()):
        found.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    return found.hexdigest()
