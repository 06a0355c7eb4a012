"""The command line, ``lw-torchrl``. Each function is a subcommand; its docstring is the help text."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NoReturn

import tyro
from tyro.conf import Positional

from lw_torchrl import __version__
from lw_torchrl.cli import experiments as cli_experiments
from lw_torchrl.cli import language as cli_language
from lw_torchrl.cli.errors import in_its_words
from lw_torchrl.cli.outputs import check_file, check_folder
from lw_torchrl.cli.streams import check_arguments, complain, nobody_reads, sound_streams
from lw_torchrl.cli.threads import use_one_thread


def demo(out: Path | None = None, quick: bool = False) -> None:
    """Train a plan-conditioned policy on MT10 and show it: demonstrations, training, evaluation, a recording.

    Takes some minutes on two cores. Stopped and started again it carries on.

    Args:
        out: folder for results.json, success.png, rollout.rrd, checkpoint.zip and config.json; runs/demo, or
            runs/demo-quick with --quick.
        quick: two tasks and little training, in under a minute; not a measure of anything.
    """
    folder = check_folder("--out", out or Path("runs/demo-quick" if quick else "runs/demo"))
    from lw_torchrl.experiments.demo import QUICK, DemoConfig, run_demo

    use_one_thread()
    run_demo(folder, QUICK if quick else DemoConfig())


def collect(
    tasks: Positional[tuple[str, ...]],
    /,
    out: Path,
    episodes: int = 10,
    seed: int = 0,
    noise: tuple[float, ...] = (0.0,),
    noise_hold: int = 10,
    redraw_failures: bool = False,
    num_envs: int | None = None,
) -> None:
    """Collect demonstrations of the scripted experts. Stopped and started again it carries on.

    Example: lw-torchrl collect MT10 --out demos/mt10 --noise 0 0.1 0.2 --redraw-failures

    Args:
        tasks: MT10, MT50, or names of tasks.
        out: the dataset's folder.
        episodes: kept for each task.
        seed: evaluate on another one.
        noise: standard deviations of the execution noise, gone through in turn, one an episode.
        noise_hold: steps for which each draw of the noise is kept; longer leads further astray.
        redraw_failures: keep successful episodes only.
        num_envs: environments stepped together; the dataset does not depend on it.
    """
    check_folder("--out", out)
    from lw_torchrl.data import collect_demonstrations

    made = collect_demonstrations(
        tasks[0] if len(tasks) == 1 else tasks,
        episodes_per_task=episodes,
        root=out,
        seed=seed,
        noise_scale=noise,
        noise_hold=noise_hold,
        redraw_failures=redraw_failures,
        num_envs=num_envs,
    )
    print(f"{'task':28} {'success':>7} {'episodes run':>13}")
    for task, rate in made.success_rate.items():
        print(f"{task:28} {rate:7.2f} {made.attempts[task]:13}")
    print(f"{made.num_steps} steps in {made.root}")


def train(
    data: Positional[Path],
    /,
    out: Path,
    plans: str = "MT10",
    method: str = "pcbc",
    mix: Literal["latents", "actions"] = "latents",
    features: Literal["raw", "differences", "relative", "both"] = "differences",
    width: int = 256,
    depth: int = 3,
    steps: int = 8000,
    batch_size: int = 500,
    learning_rate: float = 1e-3,
    after_success: int | None = 20,
    seed: int = 0,
) -> None:
    """Train a policy on demonstrations. Stopped and started again it carries on from its checkpoint.

    Example: lw-torchrl train demos/mt10 --out runs/mt10.zip

    Args:
        data: a dataset's folder, of `lw-torchrl collect`.
        out: the checkpoint, one file.
        plans: MT10 or MT50 for the shipped plans, or a .plan file or a folder of them.
        method: pcbc, conditioned on the plan; or a baseline: dc, on the task's description, one-hot, on its number.
        mix: mix the skills' latents, as in the paper, or their actions.
        features: what the policy sees: the raw observation; differences between hand, objects and goal; relative, these
            without the hand's height and the gripper's opening; or both the first and the second.
        width: of the action decoder's hidden layers.
        depth: number of them.
        steps: minibatches.
        batch_size: rows of a minibatch, equally many of each task.
        learning_rate: at the start; a cosine brings it to 0.
        after_success: leave out steps so long after an episode's first success; None keeps all.
        seed: of the initial weights and the minibatches.
    """
    check_file("--out", out)
    import torch

    import lw_torchrl as lw
    from lw_torchrl._checks import check_choice
    from lw_torchrl.modules.policy import METHODS, make_policy, policy_class

    use_one_thread()
    options: dict[str, Any] = {"features": features, "width": width, "depth": depth}
    config = lw.BehavioralCloningConfig(steps=steps, batch_size=batch_size, learning_rate=learning_rate, seed=seed)
    replay = lw.LanguageWorldExperienceReplay(data, sampler=lw.TaskBalancedSampler(), after_success=after_success)
    torch.manual_seed(seed)
    loaded = lw.load_plans(plans)
    loaded.require(replay.tasks)
    if policy_class(METHODS[check_choice("method", method, METHODS)].policy).plan_options:
        options["mix"] = mix
    actor = make_policy(method, loaded, **options)
    if (transform := actor.transform()) is not None:
        replay.append_transform(transform)
    loss = lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=out).train()
    print(f"trained to step {steps}" + ("" if loss != loss else f", loss {loss:.4f}") + f": {out}")


def evaluate(
    checkpoint: Positional[Path],
    /,
    tasks: tuple[str, ...] = (),
    episodes: int = 20,
    seed: int = 1000,
    noise: float = 0.1,
    stop_at_success: bool = False,
    num_envs: int | None = None,
    out: Path | None = None,
) -> None:
    """Evaluate a trained policy, or the scripted experts, and write the result, a figure and a recording.

    Example: lw-torchrl evaluate runs/mt10.zip --out runs/mt10

    Args:
        checkpoint: of `lw-torchrl train`, or the word expert.
        tasks: MT10, MT50, or names of tasks; those of the policy's plans if none is given.
        episodes: of each task.
        seed: fixes initial states, goals and noise; not one that the demonstrations used.
        noise: standard deviation of the noise on the executed action.
        stop_at_success: end an episode at its first success; any-step success stays the same.
        num_envs: environments stepped together; the result does not depend on it.
        out: folder for results.json, success.png and rollout.rrd.
    """
    if out is not None:
        check_folder("--out", out)
    import lw_torchrl as lw
    from lw_torchrl.modules.policy import Policy
    from lw_torchrl.record.rollouts import rollout_tasks, write_recording
    from lw_torchrl.trainers.checkpoint import demonstration_seeds

    use_one_thread()
    chosen: str | tuple[str, ...] = tasks[0] if len(tasks) == 1 else tasks
    policy: Policy | None = None
    if str(checkpoint) == "expert":
        chosen = chosen or "MT10"
    else:
        if seed in demonstration_seeds(checkpoint):
            raise ValueError(
                f"seed must differ from the demonstrations' seed, {seed}; an evaluation wants fresh states"
            )
        policy = lw.load_actor(checkpoint)
        chosen = chosen or policy.tasks
    result = lw.evaluate(
        policy or lw.ExpertActor(chosen),
        tasks=chosen,
        episodes_per_task=episodes,
        seed=seed,
        noise_scale=noise,
        stop_at_success=stop_at_success,
        num_envs=num_envs,
    )
    print(result.table())
    if out is not None:
        result.save(out / "results.json")
        lw.plot_success(result, out / "success.png", title=f"{checkpoint}, {episodes} episodes a task")
        if policy is not None:
            shown = lw.resolve_tasks(chosen)[:3]
            rollouts = rollout_tasks(policy, shown, seed=seed, noise_scale=noise)
            write_recording(out / "rollout.rrd", policy, rollouts)
        print(f"written to {out}")


def view(
    recording: Positional[Path],
    /,
    screenshot: Path | None = None,
    step: int | None = None,
    window_size: str = "1400x900",
) -> None:
    """Open a recording in the rerun viewer, or take a picture of it without a screen.

    Example: lw-torchrl view runs/demo/rollout.rrd --screenshot picture.png --step 80

    Args:
        recording: an .rrd file.
        screenshot: write a .png here and open no window; wants Debian's mesa-vulkan-drivers and libvulkan1.
        step: the step at which to take the picture; the last if none is given.
        window_size: of the picture, WIDTHxHEIGHT.
    """
    if screenshot is not None:
        check_file("--screenshot", screenshot)
    from lw_torchrl.record import open_viewer

    open_viewer(recording, screenshot, window_size, step=step)
    if screenshot is not None:
        print(f"written to {screenshot}")


def query(
    task: Positional[str],
    text: Positional[str | None] = None,
    /,
    step: int = 0,
    seed: int = 0,
    episode: int = 0,
) -> None:
    """Answer a query on a state of a task: the state after so many steps of the scripted expert.

    Example: lw-torchrl query pick-place "Is the gripper open and not above the puck?" --step 40

    Args:
        task: a task's name.
        text: the query; without one, all supported queries that hold are listed.
        step: how many steps the expert does first, 0 to 500.
        seed: of the episode.
        episode: its index.
    """
    import lw_torchrl as lw
    from lw_torchrl._checks import check_int
    from lw_torchrl.language.tasks import check_task

    name = check_task(task)
    listed = (
        [lw.parse_query(text, name)]
        if text is not None
        else [lw.parse_query(q, name) for q in lw.supported_queries(name)]
    )
    if check_int("step", step, minimum=0) > 500:
        raise ValueError(f"step must be at most 500, got {step}")
    env = lw.LanguageWorldEnv(name, seed=seed)
    state = env.reset(episode=episode)
    if step:
        state = env.rollout(step, lw.ExpertActor(name), auto_reset=False, tensordict=state)[:, -1]["next"]
    truths = lw.QueryProgram({name: listed})(state["observation"], state["task_id"])[0].tolist()
    env.close()
    for place, position in lw.TASKS[name].positions(state["observation"][0]).items():
        print(f"the {place:24} at " + " ".join(f"{number:7.3f}" for number in position.tolist()) + " m")
    print(f"the gripper's opening       {state['observation'][0, 3]:7.3f}\n")
    for found, truth in zip(listed, truths, strict=True):
        if text is not None:
            print(f"{'yes' if truth else 'no'}: {found}")
        elif truth:
            print(found)


COMMANDS: dict[str, Any] = {
    "demo": demo,
    "collect": collect,
    "train": train,
    "evaluate": evaluate,
    "view": view,
    "query": query,
    "scripted": cli_language.scripted,
    "tasks": cli_language.tasks,
    "queries": cli_language.queries,
    "skills": cli_language.skills,
    "plans": cli_language.plans,
    "check": cli_language.check,
    "reproduce": cli_experiments.reproduce,
}


RESUMABLE = ("demo", "collect", "train", "reproduce")


def main(args: Sequence[str] | None = None) -> None:
    """Run the command line; an error a user can mend is one line and exit status 2, Ctrl-C is 130."""
    given = sys.argv[1:] if args is None else list(args)
    interrupts: list[int] = []
    with sound_streams(), _noting(interrupts):
        try:
            _run(given)
        except KeyboardInterrupt:
            _stop(given)
        except Exception as error:
            if interrupts:  # raised within a library, Ctrl-C may surface as something else
                _stop(given)
            if not isinstance(error, (ValueError, TypeError, OSError, ImportError, RuntimeError)):
                raise
            if isinstance(error, BrokenPipeError) and nobody_reads():
                raise
            command = given[0] if given else ""
            message = str(error)
            if command in COMMANDS:
                message = in_its_words(command, COMMANDS[command], message)
            complain(f"lw-torchrl: error: {message}")
            sys.exit(2)


def _run(given: Sequence[str]) -> None:
    check_arguments(given)
    if list(given) == ["--version"]:
        print(f"lw-torchrl {__version__}")
        return
    try:
        tyro.extras.subcommand_cli_from_dict(
            COMMANDS,
            prog="lw-torchrl",
            description="Language-World with TorchRL: policies carried by plans in English. --version tells which.",
            args=given,
        )
    finally:
        sys.stdout.flush()


@contextmanager
def _noting(interrupts: list[int]) -> Iterator[None]:
    """Within the block Ctrl-C also leaves a note."""
    before = signal.getsignal(signal.SIGINT) if threading.current_thread() is threading.main_thread() else None
    if before is not signal.default_int_handler:
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _stop(given: Sequence[str]) -> NoReturn:
    resumed = "; the same command carries on from here" if given and given[0] in RESUMABLE else ""
    complain(f"\nlw-torchrl: stopped{resumed}")
    sys.exit(130)
