"""Train the policy (appendix D.1), on its encoder if it has one.

Run: python -m platform.launch +exp=train
Expect: the policy folder, its checkpoints under `train/`, and a learning curve in
`train/results.jsonl`. If a run stops, the same command resumes it from its last complete
checkpoint; no environment step is reported twice. After the loss of a process or a machine the
training is retried at once, after an error of the code it is not: the error would repeat.
"""

import contextlib
import math
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import pyarrow.fs
import torch
from ray import tune
from ray.rllib.core.rl_module.rl_module import RLModule

from jobs.config.config import Config
from jobs.config.plugins import with_culprit
from jobs.rollout.diagnostics import DRIFT_METRICS
from jobs.run.checkpoints import mend, seal
from jobs.run.files import append_json_lines, read_json_lines
from jobs.run.folder import Run, finish, finished, open_run
from jobs.run.progress import console, progress
from jobs.run.ray_cluster import fit, holds, start_ray, storage
from jobs.run.trial_errors import low_memory, newest_error
from jobs.run.tune_state import keep_state, mend_state
from jobs.tracking.tracker import open_tracker
from jobs.training.algorithms import Algorithm, algorithm_of
from jobs.training.candidates import best_of, candidate_run, candidate_seeds, show, take, validate
from jobs.training.inputs import check_cpus, check_inputs, prepare_inputs
from jobs.training.policy import policy_about, policy_spec
from jobs.training.ppo.algorithm import NOTICE
from jobs.training.sampling.env_runner import RolloutError
from models.encoder.weights import EncoderManifest, load_encoder
from models.policy import save_policy
from models.policy.policy import NETWORKS
from models.policy.rllib_module import PolicyModule

OnResult = Callable[[int, Mapping[str, float]], None]

# Name in the tracker -> path in RLlib's result.
METRICS = {
    "train/episode_return": ("env_runners", "episode_return"),
    "train/episodes": ("env_runners", "num_episodes_lifetime"),
    "train/success_rate": ("env_runners", "success_rate"),
    "train/collision_rate": ("env_runners", "collision_rate"),
    "train/distance_m": ("env_runners", "distance_m"),
    "sim/events_per_step": ("env_runners", "events_per_step"),
    "sim/dropped_events": ("env_runners", "dropped_events"),
    **{f"evae/{name}": ("env_runners", name) for name in DRIFT_METRICS},
    "perf/env_runner_restarts": ("fault_tolerance", "num_remote_worker_restarts"),
    "perf/trial_restarts": ("trial_restarts",),
}
ENV_STEPS = "num_env_steps_sampled_lifetime"
SAMPLED = ("env_runners", "num_env_steps_sampled")
LEARNER = ("learners", "default_policy")
LEARNED_STEPS = "num_module_steps_trained"
MODULE = Path("learner_group", "learner", "rl_module", "default_policy")
MAX_FAILURES = 2
CHECKPOINTS_KEPT = 3  # one more than Tune's state may name after a kill
RAISED = re.compile(r"^(?:\w+\.)*\w+(?:Error|Exception|Exit|Interrupt)\b.*$", re.MULTILINE)

_listeners: list[Callable[[Mapping[str, Any]], None]] = []  # the last one receives the results


class TrainingError(RuntimeError):
    """Training stopped; the message says in one line why, and how to resume."""


class Relay(tune.Callback):
    """Passes results to the listener of this process, see `relayed_to`.

    Tune pickles its callbacks into the experiment's state. Neither a tracker nor a progress
    bar can be pickled, so the callback has no attributes.
    """

    def on_trial_result(
        self, iteration: int, trials: list[Any], trial: Any, result: dict[str, Any], **info: Any
    ) -> None:
        """Pass on a result with the number of restarts so far, and print its notice."""
        if NOTICE in result:
            console.print(result[NOTICE])
        _listeners[-1]({**result, "trial_restarts": trial.num_failures})

    def on_checkpoint(
        self, iteration: int, trials: list[Any], trial: Any, checkpoint: tune.Checkpoint, **info: Any
    ) -> None:
        """Seal a checkpoint, and copy Tune's state of the training."""
        if on_disk(checkpoint):
            seal(Path(checkpoint.path))
            keep_state(Path(checkpoint.path).parents[1])

    def on_trial_recover(self, iteration: int, trials: list[Any], trial: Any, **info: Any) -> None:
        """Report that the training resumes, or stop it if its code raised an error."""
        error = newest_error(trial.error_file)
        raised = RAISED.findall(error)
        if raised and not raised[-1].startswith("ray.exceptions."):
            raise TrainingError(stopped(error))
        reason = last_line(error) if error else "its process could not be started"
        console.print(f"Cut off, goes on from its last checkpoint: {reason}")


def run(config: Config) -> dict[str, float]:
    """Collect and pretrain if the policy needs it and it is not done; then train; return the metrics."""
    check_inputs(config)
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        train(folder, prepare_inputs(folder, tracker), tracker.log)
    return finished(folder, "train") or {}


def train(folder: Run, encoder_path: Path | None, on_result: OnResult) -> Path:
    """Train like `train_one`; with several `train.candidates`, the best one becomes the run's policy.

    Candidates share the run's encoder. Each has a folder in the run folder, from which it resumes if stopped.
    """
    if finished(folder, "train") is not None:
        return folder.policy
    config = folder.config
    if config.train.candidates == 1:
        return train_one(folder, encoder_path, on_result)
    runs = {seed: candidate_run(folder, seed) for seed in candidate_seeds(config)}
    for seed, own in runs.items():
        console.print(f"Candidate with seed {seed}, one of {len(runs)}")
        if folder.init.is_dir():
            shutil.copytree(folder.init, own.init, dirs_exist_ok=True)
        train_one(own, encoder_path, lambda _steps, _metrics: None)
    rates = validate(folder, {seed: own.policy for seed, own in runs.items()})
    best = best_of(rates)
    show(rates, best)
    take(folder, runs[best], rates)
    for env_steps, metrics in read_results(folder.train / "results.jsonl"):
        on_result(env_steps, metrics)
    finish(folder, "train", finished(runs[best], "train") or {})
    return folder.policy


def train_one(folder: Run, encoder_path: Path | None, on_result: OnResult) -> Path:
    """Train until `train.env_steps`, from the newest checkpoint if there is one; export the policy.

    Args:
        folder: The run folder.
        encoder_path: The pretrained encoder's file; None for a policy without one.
        on_result: Called with (environment steps, metrics) after each iteration, in this
            process; a metric that was not measured is NaN.

    Returns:
        The policy folder, complete in itself.

    Raises:
        TrainingError: Training failed, or a loss is not finite.
    """
    if finished(folder, "train") is not None:
        return folder.policy
    config = folder.config
    check_cpus(config)
    start_ray(config.cluster, folder.path)
    init = folder.init / NETWORKS if config.train.init else None
    built = algorithm_of(config).build(config, encoder_path, init)
    with _listening(folder, on_result) as last:
        results = fit(_tuner(folder, built))
    if results.errors:
        raise TrainingError(stopped(results.errors[0]))
    figures = {name: value for name, value in last.items() if math.isfinite(value)}
    with results[0].checkpoint.as_directory() as checkpoint:
        export_policy(config, Path(checkpoint), encoder_path, folder.policy, figures)
    finish(folder, "train", figures)
    return folder.policy


def stopped(error: Exception | str) -> str:
    """Return the message for a training that an error ended."""
    return f"training stopped: {last_line(error)}; the same command continues from its last checkpoint"


def last_line(error: Exception | str) -> str:
    """Return the line of a worker's error that names its cause."""
    ended = low_memory(str(error))
    if ended is not None:
        return f"its process was ended {ended}; stop other programs, or take a machine with more"
    lines = str(error).strip().splitlines()
    raised = f"{RolloutError.__module__}.{RolloutError.__qualname__}: "  # as Ray writes it before the message
    said = lines[-1].strip().removeprefix(raised) if lines else type(error).__name__
    return with_culprit(said, str(error))


def export_policy(
    config: Config, checkpoint: Path, encoder_path: Path | None, target: Path, figures: dict[str, float]
) -> None:
    """Write the policy in a checkpoint of this run as a policy folder.

    Raises:
        TrainingError: The checkpoint's encoder is not the one in the file.
    """
    spec, module = policy_spec(config), cast(Any, RLModule.from_checkpoint(checkpoint / MODULE))
    evae, of_encoder = None, EncoderManifest()
    if encoder_path is not None and spec.frozen:
        evae, of_encoder = load_encoder(encoder_path)
    frozen = {} if evae is None else evae.state_dict()
    encoder = module.encoder if isinstance(module, PolicyModule) else None
    trained_on = {} if encoder is None else encoder.state_dict()
    if not all(torch.equal(value, frozen[name]) for name, value in trained_on.items()):
        raise TrainingError(f"{encoder_path}: not the encoder that {checkpoint} was trained on; train again")
    about = {**policy_about(config), "figures": figures}
    networks = algorithm_of(config).networks(module, spec)
    save_policy(target, networks, spec, about, evae, of_encoder.get("figures"))


def _tuner(folder: Run, built: Any) -> tune.Tuner:
    """Return Tune's experiment of the run folder: the existing one, else a new one."""
    config = folder.config
    path, trainable = storage(config.cluster, folder.train), algorithm_of(config).trainable(config)
    if can_continue(path, folder.train):
        stopped_at = restored(path, trainable, built).get_results()[0].checkpoint
        said = mend(Path(stopped_at.path)) if stopped_at and on_disk(stopped_at) else None
        if said:
            console.print(said)
        return restored(path, trainable, built)
    return tune.Tuner(
        trainable,
        param_space=built,
        run_config=run_config(
            path, config.train.checkpoint_every, at_end=True, stop={ENV_STEPS: config.train.env_steps}
        ),
    )


def can_continue(path: str, folder: Path) -> bool:
    """Repair Tune's state of an experiment if needed, and print that; return whether Tune can resume it.

    Args:
        path: Where the experiment is stored: a path or an address.
        folder: Its folder on this machine.
    """
    said = mend_state(folder)
    if said:
        console.print(said)
    # If Tune is killed before its first checkpoint of the experiment, it leaves a folder it cannot restore.
    return bool(tune.Tuner.can_restore(path)) and holds(path, "experiment_state-")


def run_config(path: str, checkpoint_every: int, at_end: bool | None = None, **more: Any) -> tune.RunConfig:
    """Return Tune's run configuration: stored at `path`, with a `Relay`, keeping the newest checkpoints.

    Args:
        path: As `jobs.run.ray_cluster.storage` returns it.
        checkpoint_every: Iterations from one checkpoint to the next.
        at_end: Whether to write a checkpoint at the end too; None: Tune's default.
        **more: Other arguments of `tune.RunConfig`.
    """
    place, _, name = path.rpartition("/")
    return tune.RunConfig(
        name=name,
        storage_path=place,
        verbose=0,
        callbacks=[Relay()],
        failure_config=tune.FailureConfig(max_failures=MAX_FAILURES),
        checkpoint_config=tune.CheckpointConfig(
            checkpoint_frequency=checkpoint_every, num_to_keep=CHECKPOINTS_KEPT, checkpoint_at_end=at_end
        ),
        **more,
    )


def on_disk(checkpoint: tune.Checkpoint) -> bool:
    """Whether a checkpoint lies in a local folder; an object store checks its own files."""
    return isinstance(checkpoint.filesystem, pyarrow.fs.LocalFileSystem)


def restored(path: str, trainable: type, built: Any) -> tune.Tuner:
    """Return the experiment stored at `path`, ready to resume."""
    return tune.Tuner.restore(path, trainable, resume_errored=True, param_space=built)


@contextlib.contextmanager
def _listening(folder: Run, on_result: OnResult) -> Iterator[dict[str, float]]:
    """Record, show and pass on each new result; yield the newest metrics, a dict updated in place."""
    config, file = folder.config, folder.train / "results.jsonl"
    done = read_results(file)
    reported, last = done[-1] if done else (0, {})
    algorithm, total, since_s = algorithm_of(config), config.train.env_steps, time.monotonic()
    with progress("Train the policy", total, "steps", done=reported) as advance:

        def listen(result: Mapping[str, object]) -> None:
            nonlocal reported, since_s
            now_s, env_steps = time.monotonic(), int(_lookup(result, (ENV_STEPS,)))
            last.update(read_metrics(result, now_s - since_s, algorithm))
            since_s = now_s
            if env_steps <= reported:
                return
            row = {name: value if math.isfinite(value) else None for name, value in last.items()}
            append_json_lines(file, [{"env_steps": env_steps, **row}])
            on_result(env_steps, dict(last))
            advance(env_steps - reported, note=_note(last))
            reported = env_steps

        with relayed_to(listen):
            yield last


@contextlib.contextmanager
def relayed_to(listen: Callable[[Mapping[str, Any]], None]) -> Iterator[None]:
    """Pass each result that a `Relay` receives to `listen`, until the block ends."""
    _listeners.append(listen)
    try:
        yield
    finally:
        _listeners.pop()


def read_results(file: Path) -> list[tuple[int, dict[str, float]]]:
    """Return environment steps and metrics of each complete line of a results file; NaN: not measured.

    Raises:
        RunError: A line is damaged.
    """
    return [
        (int(row.pop("env_steps")), {name: math.nan if x is None else x for name, x in row.items()})
        for row in read_json_lines(file)
    ]


def read_metrics(result: Mapping[str, object], seconds: float, algorithm: Algorithm) -> dict[str, float]:
    """Return the metrics to record from an RLlib result; NaN for what was not measured.

    Args:
        result: Result of one iteration.
        seconds: Time since the previous result [s], on a monotonic clock; RLlib's may jump.
        algorithm: Algorithm whose losses and figures are recorded.

    Raises:
        TrainingError: A loss is NaN or infinite; RLlib would continue without a message.
    """
    learnt = {name: (*LEARNER, key) for name, key in {**algorithm.losses, **algorithm.figures}.items()}
    metrics = {name: _lookup(result, path) for name, path in {**METRICS, **learnt}.items()}
    steps = _lookup(result, SAMPLED)
    metrics["perf/env_steps_per_second"] = steps / seconds if seconds > 0 else math.nan
    updated: Any = result.get("learners", {})
    learner = updated.get(LEARNER[-1], {})
    # Without a gradient step in an iteration, RLlib's IMPALA reports NaN steps and NaN losses.
    learned = not math.isnan(learner.get(LEARNED_STEPS, 0.0))
    told = [name for name, key in algorithm.losses.items() if learned and key in learner]
    bad = [f"{name} = {metrics[name]}" for name in told if not math.isfinite(metrics[name])]
    if bad:
        where = f"at environment step {result[ENV_STEPS]}"
        raise TrainingError(f"losses must be finite, got {', '.join(bad)} {where}")
    return metrics


def _lookup(result: Mapping[str, object], path: tuple[str, ...]) -> float:
    value: Any = result
    for key in path:
        value = value.get(key) if isinstance(value, Mapping) else None
    return math.nan if value is None else float(value)


def _note(metrics: Mapping[str, float]) -> str:
    """Return the note at the progress bar: speed, mean return and success rate."""
    parts = [f"{metrics['perf/env_steps_per_second']:,.0f} steps/s"]
    if not math.isnan(metrics["train/episode_return"]):
        parts.append(f"return {metrics['train/episode_return']:.1f}")
        parts.append(f"success {metrics['train/success_rate']:.0%}")
    return ", ".join(parts)
