"""Measure how training and sweeps scale with cores, on simulated nodes of this machine, and model it.

Run: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.scaling [docs/data/scaling.json]
Expect: five tables in about five minutes, and their numbers in a file if one is named, from which
`python -m docs.from_data` draws the plot; the machine should be idle. Nodes beyond this machine's cores
share them, so measured rates stop growing; the model predicts the rates of separate machines. Its inputs are
measured: seconds of a core per simulated step, seconds of the learner and bytes through the object store per
learned step, seconds of a core per condition, seconds of the driver per trial.
"""

import contextlib
import logging
import os
import pickle
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import ray
from ray import tune
from ray._private.authentication.authentication_token_setup import enable_token_auth_by_default
from ray.cluster_utils import Cluster

from benchmarks.scaling_model import CORES, STEPS, Costs, Measured, as_plain, conditions_per_s, iteration_s
from benchmarks.throughput import composed
from envs.config import EnvConfig
from jobs.analysis.tables import show_table
from jobs.config.config import HELD_OUT_SCENE
from jobs.rollout.episodes import roll_out
from jobs.rollout.executors import cached_agent
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import write_json
from jobs.run.libraries import of_workers
from jobs.run.provenance import git_commit, today
from jobs.run.ray_cluster import QUIET, on_loopback, ray_folder, use_token
from jobs.training.algorithms import build_algorithm
from jobs.training.sampling.env_runner import PlainEnvRunner

ROUNDS = 3
TRIALS = 1000
CONDITIONS, EPISODES = 12, 7  # conditions to evaluate; episodes of a condition, as in the default sweep
POLICY = "event_columns-s0"
OBJECT_STORE = 150 * 2**20


def main() -> None:
    """Measure, print the tables, and write the measurements to a file if one is named."""
    settings = ["model=event_columns", "algo=ppo_fast", "algo.lr_schedule=constant"]
    step_bytes, weight_bytes = bytes_sent(*settings)
    rates: dict[tuple[int, int], float] = {}
    sweeps: dict[int, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        ask_for_token(Path(folder))
        for nodes, cores in ((1, 1), (1, 2), (2, 2)):
            with simulated(nodes, cores):
                sweeps[nodes * cores] = CONDITIONS / seconds_of(
                    evaluate_condition, CONDITIONS, Path(folder) / f"{nodes}{cores}"
                )
        for nodes in (1, 2):
            with simulated(nodes, cores=2):
                for runners in (0, 1, 2, 4)[: 3 if nodes == 1 else 4]:
                    words = [*settings, f"algo.num_env_runners={runners}"]
                    rates[nodes, runners], step_s, learn_s = training_rate(*words)
                    if runners == 0:
                        alone = step_s, learn_s
        with simulated(1, cores=2):
            trial_s = seconds_of(do_nothing, TRIALS, Path(folder) / "nothing") / TRIALS
    costs = Costs(*alone, step_bytes, weight_bytes, 1 / sweeps[1], trial_s)
    show_measured(rates, sweeps)
    show_model(costs)
    if sys.argv[1:]:
        measured = Measured(os.cpu_count() or 1, costs, rates, sweeps)
        source = f"measured on {today()} at commit {git_commit()}"
        write_json(Path(sys.argv[1]), as_plain(measured, source))


def show_measured(rates: Mapping[tuple[int, int], float], sweeps: Mapping[int, float]) -> None:
    """Print the measurements on this machine."""
    show("Training, measured", ("nodes", "env runners", "env steps/s"),
         [(n, r, f"{rate:,.0f}") for (n, r), rate in rates.items()])  # fmt: skip
    show("A sweep, measured", ("cores by Ray's account", "conditions/h"),
         [(cores, f"{3600 * rate:,.0f}") for cores, rate in sweeps.items()])  # fmt: skip


def show_model(costs: Costs) -> None:
    """Print the costs, and the rates that the model predicts for more cores."""
    show("Costs", ("of", "is"), [(name, f"{value:.3g}") for name, value in costs._asdict().items()])
    show(
        "Training, the model",
        ("cores", "env steps/s", "sampling", "learning", "sending"),
        [(cores, f"{STEPS / sum(parts):,.0f}", *(f"{part / sum(parts):.0%}" for part in parts))
         for cores in CORES for parts in [iteration_s(costs, cores)]],
    )  # fmt: skip
    show(
        "A sweep, the model",
        ("cores", "conditions/h", "saturates first"),
        [(cores, f"{3600 * conditions_per_s(costs, cores):,.0f}",
          "cores" if cores / costs.cell_s < 1 / costs.trial_s else "the driver") for cores in CORES],
    )  # fmt: skip


def bytes_sent(*words: str) -> tuple[float, float]:
    """Return the bytes of a step's sample and of the weights, as sent between processes."""
    here = build_algorithm(composed(*words, "algo.num_env_runners=0"))
    runner = PlainEnvRunner(config=here, worker_index=0)
    episodes = runner.sample(num_timesteps=STEPS)
    weights = runner.get_state(components="rl_module", inference_only=True)
    runner.stop()
    steps = sum(len(episode) for episode in episodes)
    return len(pickle.dumps(episodes, protocol=5)) / steps, float(len(pickle.dumps(weights, protocol=5)))


def training_rate(*words: str) -> tuple[float, float, float]:
    """Return an iteration's environment steps per second, and seconds of sampling and learning per step."""
    algorithm = build_algorithm(composed(*words)).build_algo()
    algorithm.train()  # compiles
    rates, shares = [], []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        result: Any = algorithm.train()
        rates.append(STEPS / (time.perf_counter() - start))
        timers = result["timers"]
        shares.append((timers["env_runner_sampling_timer"] / STEPS, timers["learner_update_timer"] / STEPS))
    algorithm.stop()
    sampling, learning = (statistics.median(column) for column in zip(*shares, strict=True))
    return statistics.median(rates), sampling, learning


def seconds_of(trial: Callable[[dict[str, int]], None], count: int, folder: Path) -> float:
    """Return the wall time [s] of `count` trials, scheduled as in a sweep, with a worker per core ready."""
    os.environ["TUNE_GLOBAL_CHECKPOINT_S"] = "3600"
    logging.getLogger("ray.tune").setLevel(
        logging.ERROR
    )  # else a line for each trial without a file of its own
    cores = int(ray.cluster_resources()["CPU"])
    for number, name in ((cores, "first"), (count, "timed")):
        tuner = tune.Tuner(
            tune.with_resources(trial, {"cpu": 1}),
            tune_config=tune.TuneConfig(reuse_actors=True),
            param_space={"trial": tune.grid_search(list(range(number)))},
            run_config=tune.RunConfig(name=name, storage_path=str(folder), verbose=0),
        )
        start = time.perf_counter()
        results = tuner.fit()
        seconds = time.perf_counter() - start
        done = sum(result.metrics is not None and "key" in result.metrics for result in results)
        if done != number:
            raise RuntimeError(f"{number} trials must report, got {done}")
    return seconds


def do_nothing(params: dict[str, int]) -> None:
    """Run a trial that costs only its scheduling."""
    tune.report({"key": params["trial"]})


def evaluate_condition(params: dict[str, int]) -> None:
    """Run a trial that evaluates a policy under the default condition."""
    first = params["trial"] * EPISODES
    agent = cached_agent(str(PRETRAINED / POLICY), "stochastic")
    env = EnvConfig(scene=HELD_OUT_SCENE, split="eval")
    roll_out(agent, env, range(first, first + EPISODES), EPISODES)
    tune.report({"key": params["trial"]})


def ask_for_token(folder: Path) -> None:
    """Let the clusters of this process require a token, which is created in `folder`."""
    os.environ.update({**QUIET, "RAY_TMPDIR": str(ray_folder())})
    use_token(folder / "token")
    enable_token_auth_by_default()  # Ray, imported above, has read the environment already


@contextlib.contextmanager
def simulated(nodes: int, cores: int) -> Iterator[None]:
    """Run a Ray of `nodes` nodes on this machine's loopback, each of which claims `cores` cores."""
    with on_loopback():
        cluster = Cluster(
            initialize_head=True,
            head_node_args={
                "num_cpus": cores,
                "object_store_memory": OBJECT_STORE,
                "include_dashboard": False,
            },
        )
        try:
            for _ in range(nodes - 1):
                cluster.add_node(num_cpus=cores, object_store_memory=OBJECT_STORE)
            ray.init(cluster.address, runtime_env={"env_vars": of_workers()}, log_to_driver=False)
            yield
        finally:
            ray.shutdown()
            cluster.shutdown()


def show(title: str, heads: tuple[str, ...], rows: list[tuple[object, ...]]) -> None:
    """Print a table of numbers."""
    show_table(title, heads, [tuple(map(str, row)) for row in rows], 0)


if __name__ == "__main__":
    main()
