"""OnlineTrainer: a policy, its environment, and demonstrations; in rounds, between which it can be stopped."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from hashlib import sha256
from typing import Any, Unpack

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from lw_torchrl._checks import checked, passes_on
from lw_torchrl._devices import CPU, drawn_on
from lw_torchrl._progress import Progress
from lw_torchrl._versions import LIBRARIES, SIMULATORS
from lw_torchrl.data.co_learning_sampler import GROWN, CoLearningSampler
from lw_torchrl.data.growing import GrowingStorage
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.data.replay_checks import check_minibatches, check_replay
from lw_torchrl.data.rewards import REWARDS
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.critics import QValue
from lw_torchrl.modules.policy import Policy
from lw_torchrl.suites.suite import Suite, find_suite, listed_tasks
from lw_torchrl.training.algorithms import LEARNERS, OnlineConfig, method_config
from lw_torchrl.training.algorithms.learner import NoiseConfig
from lw_torchrl.training.checkpoint import check_can_be_saved
from lw_torchrl.training.loop import Interrupt, Training, TrainingOptions, describe_data, describe_replay

_MOST_EPISODES = 1_000_000


class OnlineTrainer(Training):
    """Trains a policy in its environment, beside demonstrations.

    In a round, each row of the environment runs episodes, which end at their first success or after ``max_steps``;
    their steps go into the buffer, and the learner makes its gradient steps. At its end all rows are reset, and a
    checkpoint is written, from which training goes on with the same bits.

    Args:
        actor: the policy to begin with, one that was cloned, say. "advantage", "td3" and "expert-iteration" train it in
            place, and so does "residual" a :class:`ResidualActor`; the others train one that is made of it.
        replay: demonstrations that grow: ``LanguageWorldExperienceReplay(..., grow=, label="executed",
            terminate_on_success=True, sampler=CoLearningSampler("grown"))`` with a reward and the actor's transform.
        config: how to train: the method's own configuration, of :mod:`lw_torchrl.training.algorithms`, or an
            :class:`OnlineConfig` for the method's defaults of all else; None for its defaults.
        method: a name of :data:`LEARNERS`, whose classes say what they do.
        tasks: to run, as for :class:`LanguageWorldEnv`; None for those of the demonstrations.
        suite: that has the tasks; None for the one that their names begin with.
        critic: whose copies are trained, where the method has one, with its normalisation as it is
            (``critic.fit_normalization``); None for one that sees what the actor sees, by the actor's.
        checkpoint, logger, progress, title: as of :class:`~lw_torchrl.training.loop.Training`, with its errors; the
            checkpoint holds the buffer's rows too, and what ``history`` holds is logged, by steps of the environment.
        num_threads: of the simulation, which changes no result.

    Attributes:
        policy: what is trained.
        frames: steps of the environment done.
        history: of each round, "frames", "episodes" (those that ended), the means of losses and values, and "success",
            that of the first episode of each row, which has the time to end; not of a round shorter than an episode.

    Raises:
        ValueError: a wrong method; a buffer that does not grow, or is not of these plans.
        TypeError: the actor is no :class:`Policy`, or none that the method can train; another method's configuration.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> from lw_torchrl.training.algorithms import TD3Config
        >>> plans = lw.load_plans("MT10")
        >>> options = {"grow": 1_000, "label": "executed", "terminate_on_success": True}
        >>> options |= {"sampler": lw.CoLearningSampler("grown"), "transform": lw.QAFTransform(plans)}
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", **options)
        ...     config = TD3Config(frames=40, rows=4, round_steps=5, max_steps=5, first_frames=20, batch_size=8)
        ...     trainer = lw.OnlineTrainer(lw.PlanConditionedActor(plans), replay, config, progress=False)
        ...     trainer.train()
        >>> [one["frames"] for one in trainer.history]
        [20, 40]

    Source: Ball et al., 'Efficient Online Reinforcement Learning with Offline Data'; Anthony et al., 'Thinking Fast and
    Slow with Deep Learning and Tree Search', for expert iteration.
    """

    part = "actor"

    @passes_on(Training.__init__)
    @checked
    def __init__(
        self,
        actor: Policy,
        replay: LanguageWorldExperienceReplay,
        config: OnlineConfig | None = None,
        *,
        method: str = "td3",
        tasks: str | Task | Iterable[str | Task] | None = None,
        suite: str | Suite | None = None,
        critic: QValue | None = None,
        num_threads: int | None = None,
        **options: Unpack[TrainingOptions],
    ) -> None:
        config = method_config(method, config)
        options.setdefault("title", f"training {method}")
        super().__init__(config, [replay], **options)
        check_can_be_saved(actor)
        check_growing_replay(actor, replay, config)
        if critic is not None:
            check_minibatches([critic], replay, config.batch_size)
        self.method, self.replay, self.num_threads = method, replay, num_threads
        given: Any = replay.tasks if tasks is None else listed_tasks(tasks)
        self.suite = find_suite(given, suite)
        self.tasks = self.suite.named_tasks(given)
        generator = torch.Generator().manual_seed(config.seed)
        replay.set_rng(generator)
        self._drawn = generator.get_state()
        start = _fingerprint(actor)
        with drawn_on(CPU, self._drawn):
            self.learner = LEARNERS[method](actor, replay, config, critic)
            self._drawn = torch.get_rng_state()
        self.policy = self.module = self.learner.policy
        self._patience = longest_standstill(replay[: len(replay) - replay.storage.num_grown])
        self.history: list[dict[str, float]] = []
        self.round = 0
        self._episodes: Tensor | None = None
        if self.checkpoint is not None:
            self.described = {
                "actor": self.policy.describe(),
                "start": {"weights": start},
                "critic": {} if critic is None else {"weights": _fingerprint(critic)},
                "online": {"method": method, "tasks": list(self.tasks), **asdict(config)},
                "data": describe_data(replay),
                "replay": describe_replay(replay),
            }
        self.resume((*SIMULATORS, *LIBRARIES))

    @property
    def frames(self) -> int:
        return min(self.round * self.config.round_steps * self.config.rows, self.config.frames)

    def state_dict(self) -> dict[str, Any]:
        return {
            "round": self.round,
            "drawn": self._drawn.clone(),
            "episodes": self._episodes,
            "history": self.history,
            "learner": self.learner.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def load_state_dict(self, found: dict[str, Any]) -> None:
        self.learner.load_state_dict(found["learner"])
        self.replay.load_state_dict(found["replay"])
        self._episodes, self._drawn = found["episodes"].clone(), found["drawn"].clone()
        self.history = [
            {str(name): value if type(value) is int else float(value) for name, value in one.items()}
            for one in found["history"]
        ]
        self.round, self.steps = found["round"], self.learner.made

    def train(self) -> None:
        """Train to the last step of the environment, from the last round's end.

        Ctrl-C ends it between two steps, and what came since the last round's end is lost; a second Ctrl-C at once.
        """
        base = LanguageWorldEnv(
            list(self.tasks.values()),
            suite=self.suite,
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
            with self.at_work(self.config.frames, self.frames) as (bar, interrupt):
                if self._episodes is not None:
                    base.set_extra_state(self._episodes)
                while self.round < self.config.rounds and not interrupt.asked:
                    with drawn_on(CPU, self._drawn):
                        done = self._run_round(env, bar, interrupt)
                        drawn = torch.get_rng_state()
                    if done is None:
                        break
                    self._drawn, self._episodes = drawn, base.get_extra_state()
                    self.round, self.steps = self.round + 1, self.learner.made
                    if wrong := [name for name, value in done.items() if name.startswith("loss") and value != value]:
                        what = f"{wrong[0]} is no number in round {self.round}"
                        raise ValueError(f"{what}: the learning rate is too high")
                    self.history.append(done)
                    self.log({name: value for name, value in done.items() if name != "frames"}, int(done["frames"]))
                    self.save()
        finally:
            env.close()

    def _run_round(self, env: EnvBase, bar: Progress, interrupt: Interrupt) -> dict[str, float] | None:
        """Do a round; what to log of it, or None where it was interrupted."""
        config, learner = self.config, self.learner
        state, done_before = env.reset(), self.frames
        first = FirstEpisodes(config.rows)
        noisy = isinstance(config, NoiseConfig)
        exploration = Exploration(config, self._patience, self.policy.layout) if noisy else None
        came, due = [], 0
        steps = min(config.round_steps, config.steps - self.round * config.round_steps)
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
            steps_due = config.due(frames) - config.due(frames - rows.numel())
            learner.learn(steps_due)
            due += steps_due
            bar.update(rows.numel())
        learner.end_round(torch.cat(came, 1) if came else None, due)
        return {"frames": done_before + steps * config.rows, **first.result(), **learner.told()}


def _fingerprint(module: torch.nn.Module) -> str:
    found = sha256()
    for name, tensor in sorted(module.state_dict().items()):
        found.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
    return found.hexdigest()


def check_growing_replay(actor: Policy, replay: Any, config: OnlineConfig) -> None:
    """Raise :class:`ValueError` unless a buffer grows, and rows of the environment fit in it."""
    if not isinstance(replay, LanguageWorldExperienceReplay) or not isinstance(replay.storage, GrowingStorage):
        raise ValueError("replay must be a LanguageWorldExperienceReplay that grows: give it grow=, a number of rows")
    sampler = replay.sampler
    if not isinstance(sampler, CoLearningSampler) or sampler.target != GROWN:
        raise ValueError("replay's sampler must be CoLearningSampler('grown'), of demonstrations and new rows 1:1")
    if not replay.terminate_on_success:
        raise ValueError("replay must end at success, as the environment does: give it terminate_on_success=True")
    if replay.storage.n_steps > 1 and replay.storage.gamma != config.gamma:
        raise ValueError(f"gamma must be the replay buffer's, {replay.storage.gamma}, got {config.gamma}")
    check_replay(actor, replay, config.batch_size)


def longest_standstill(rows: TensorDictBase) -> int:
    """The most rows of an episode, one after the other, with the same truth of all conditions; 0 without ``qaf``."""
    if (truth := rows.get("qaf", None)) is None:
        return 0
    ids = rows["collector", "traj_ids"]
    changes = (truth[1:] != truth[:-1]).any(-1) | (ids[1:] != ids[:-1])
    edges = torch.cat([torch.tensor([0]), changes.nonzero().flatten() + 1, torch.tensor([len(ids)])])
    return int(edges.diff().max())


class Exploration:
    """The noise of a round. A row is stuck if no condition's truth has changed for more states than ``patience``, the
    longest time in the demonstrations (0: never). There the hand's noise grows, until half as long again, from
    ``exploration`` to ``stuck_exploration``; the gripper's would open grasps."""

    def __init__(self, config: NoiseConfig, patience: int, layout: Layout = METAWORLD) -> None:
        self.patience = patience
        moves = torch.ones(layout.action_size)
        moves[layout.effort] = config.gripper_exploration
        self._scale = moves * config.exploration
        self._stuck_scale = torch.full_like(moves, config.stuck_exploration)
        self._stuck_scale[layout.effort] = self._scale[layout.effort]
        self._drawn = torch.zeros(config.rows, layout.action_size)
        self._since = torch.zeros(config.rows)
        self._truth: Tensor | None = None

    def draw(self) -> None:
        """Draw what is kept until the next call."""
        self._drawn = torch.randn_like(self._drawn)

    def noise(self, state: TensorDictBase) -> Tensor:
        """(N, A) float32, for the actions in these states, each one step after those of the last call or the first of
        an episode; ``qaf`` (N, S) bool, if it is there."""
        truth = state.get("qaf", None)
        if not self.patience or truth is None:
            return self._drawn * self._scale
        if self._truth is not None:
            same = (truth == self._truth).all(-1)
            self._since = torch.where(same, self._since + 1, 0.0)
        self._truth = truth.clone()
        stuck = (2 * (self._since - self.patience) / self.patience).clamp(0.0, 1.0).unsqueeze(-1)
        return self._drawn * (self._scale + stuck * (self._stuck_scale - self._scale))

    def note(self, ended: Tensor) -> None:
        """Rows whose episodes ended, (N,) bool, begin anew."""
        self._since = torch.where(ended, -1.0, self._since)


class FirstEpisodes:
    """Which trajectory each row of a round is in, and how the first episode of each went."""

    def __init__(self, rows: int) -> None:
        self._episode = torch.zeros(rows, dtype=torch.int64)
        self._ended = 0
        self._success = torch.full((rows,), torch.nan)

    def ids(self, round_number: int) -> Tensor:
        """(N,) int64, of each row's trajectory: no two in a training are the same."""
        rows = len(self._episode)
        return (round_number * _MOST_EPISODES + self._episode) * rows + torch.arange(rows)

    def note(self, step: TensorDictBase) -> None:
        """Look at a step of all rows."""
        done, success = (step.get(("next", name)).squeeze(-1) for name in ("done", "success"))
        first = done & (self._episode == 0)
        self._success = torch.where(first, success.to(torch.float32), self._success)
        self._episode = self._episode + done
        self._ended += int(done.sum())

    def result(self) -> dict[str, float]:
        ended = {"episodes": float(self._ended)}
        return ended if self._success.isnan().any() else {"success": float(self._success.double().mean()), **ended}
