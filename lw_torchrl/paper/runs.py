"""The paper's experiments as runs of work: datasets, and policies trained on them and evaluated."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from lw_torchrl._checks import check_choice
from lw_torchrl._files import held
from lw_torchrl.data.collect import collect_demonstrations
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import TASKS
from lw_torchrl.modules.policy import METHODS, policy_class
from lw_torchrl.paper.recipes import DataSetting, Execution, Member, Preset

SCRIPTED = "scripted"
"""Plans with scripted skills: a method beside those of :data:`lw_torchrl.modules.policy.METHODS`, without training."""


@dataclass(frozen=True)
class Dataset:
    """Demonstrations that runs share: a run of work itself.

    Attributes:
        tasks: "MT10" or another argument of :func:`resolve_tasks`.
        episodes: demonstrations of each.
        execution: how the experts are executed.
        seed: of the initial states and the noise.
    """

    tasks: str
    episodes: int
    execution: Execution
    seed: int

    @property
    def folder(self) -> Path:
        """Where it goes, below the experiments' folder."""
        return Path("demonstrations") / f"{self.tasks}x{self.episodes}-{self.execution.name}-seed{self.seed}"

    def collect(self, out: Path, progress: bool) -> None:
        """Collect it, or what is left; of several processes one does, and the others wait."""
        root = out / self.folder
        with held(root, "out", wait=True):
            collect_demonstrations(
                self.tasks,
                episodes_per_task=self.episodes,
                root=root,
                seed=self.seed,
                noise_scale=self.execution.noise_scale,
                noise_hold=self.execution.noise_hold,
                redraw_failures=self.execution.redraw_failures,
                progress=progress,
            )


@dataclass(frozen=True)
class Run:
    """One policy, or one for each target, or plans with scripts, of one training seed: what a scheduler runs.

    Attributes:
        setting: what data it sees; scripts see none, and are the same in every setting.
        method: one of :data:`~lw_torchrl.modules.policy.METHODS`, or "scripted".
        seed: of demonstrations, initial weights and minibatches.
        preset: how to train.
        episodes: evaluated for each task.
        plans_name: part of the folder's name, for other plans than ours.
        encoder_name: that of the text encoder, for another than ours: "my_texts:encode".
    """

    setting: DataSetting
    method: str
    seed: int
    preset: Preset
    episodes: int = 20
    plans_name: str = ""
    encoder_name: str = ""

    def __post_init__(self) -> None:
        check_choice("method", self.method, (*METHODS, SCRIPTED))

    @property
    def group(self) -> Path:
        """The folder of the setting, the preset, the plans and the texts: what methods are compared in."""
        own = self.plans_name, self.encoder_name.replace(":", ".")
        return Path(self.setting.name) / "-".join(filter(None, (self.preset.name, *own)))

    @property
    def folder(self) -> Path:
        """Where its files go, below the experiments' folder."""
        if self.method == SCRIPTED:
            return Path("-".join(filter(None, ("scripted", self.plans_name)))) / f"seed{self.seed}"
        return self.group / self.method / f"seed{self.seed}"

    @property
    def datasets(self) -> tuple[Dataset, ...]:
        """What it is trained on: the base tasks' demonstrations, and the targets'."""
        if self.method == SCRIPTED:
            return ()
        base = Dataset(self.setting.base, self.setting.episodes, self.preset.base, self.seed)
        if self.setting.targets is None:
            return (base,)
        assert self.preset.target is not None
        return base, Dataset(self.setting.targets, 1, self.preset.target, self.seed)

    def actor_options(self, member: Member) -> dict[str, Any]:
        """Of one of its policy's actors."""
        more = member.plan_actor if policy_class(METHODS[self.method].policy).plan_options else {}
        return {**member.actor, **more}

    def any_yaw(self, member: Member) -> bool:
        """Whether it knows by its plans which rows of a member may be turned by any angle."""
        return member.any_yaw and policy_class(METHODS[self.method].policy).plan_options

    def _describe_member(self, member: Member) -> dict[str, Any]:
        found = {"actor": self.actor_options(member), "yaw": member.yaw}
        return found | {"any_yaw": True} if self.any_yaw(member) else found

    @property
    def skills(self) -> Literal["own", "MT10"]:
        """Whose skills its plans speak of, as for :func:`~lw_torchrl.load_plans`: what is trained on MT10 and never saw
        another task knows those of MT10 alone."""
        return "MT10" if self.setting.name == "zero-shot" and self.method != SCRIPTED else "own"

    def describe(self, plans: Plans) -> dict[str, Any]:
        """Everything that its result hangs on, as JSON."""
        reads_plans = self.method == SCRIPTED or policy_class(METHODS[self.method].policy).plan_options
        read = plans.fingerprint if reads_plans else None
        described: dict[str, Any] = {"method": self.method, "seed": self.seed, "plans": read}
        if self.method != SCRIPTED:
            described |= {
                "setting": self.setting.name,
                "preset": self.preset.name,
                "datasets": [asdict(dataset) for dataset in self.datasets],
                "members": [self._describe_member(one) for one in self.preset.members],
                "training": self.preset.training.describe(),
                "label": self.preset.label,
                "after_success": self.preset.after_success,
                "passes": self.preset.passes,
            }
            if self.preset.evaluations > 1:
                described["evaluations"] = self.preset.evaluations
        if read is None:
            described |= own_tasks(plans)
        if self.encoder_name and self.method != SCRIPTED:
            described["text_encoder"] = self.encoder_name
        return plain(described)


def own_tasks(plans: Plans) -> dict[str, Any]:
    """The tasks of plans that are not ours of that name, by which texts and objects are others: no plan's fingerprint
    tells what a description says."""
    own = {task: plan.definition.to_json() for task, plan in plans.items() if plan.definition != TASKS.get(task)}
    return {"own_tasks": own} if own else {}


def plain(value: Any) -> Any:
    """As JSON gives it back: lists for tuples."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, (list, tuple)) else value
