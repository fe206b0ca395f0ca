"""How training and sweeps grow with cores: measured on simulated nodes of this machine, then a model.

Run: OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m jobs.bench.scaling
Expect: four tables in about ten minutes; the machine should be quiet. Nodes beyond this machine's
cores share them, so that measured rates stop to grow there; the model says what they would be
alone. Its inputs are the measured ones: seconds of a core for a step flown, seconds of the learner
and bytes through the object store for a step learnt, seconds of the driver for a trial.
"""

import contextlib
import os
import pickle
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import ray
from ray import tune
from ray.cluster_utils import Cluster
from rich.table import Table

from jobs.bench.throughput import composed
from jobs.cluster import ONE_THREAD, QUIET
from jobs.ppo import build_ppo
from jobs.progress import console
from jobs.runner import PlainEnvRunner

STEPS = 2048  # of an iteration (appendix D.1.2)
ROUNDS = 3
TRIALS = 1000
CELL_S = 5.0  # of a core, for the 20 flights of a condition (docs/guide.md)
BANDWIDTH = 1e9  # of the network between nodes [bytes/s]: 10 Gbit/s
CORES = (1, 2, 10, 100, 1000)
OBJECT_STORE = 150 * 2**20


class Costs(NamedTuple):
    """What the model is made from.

    Attributes:
        step_s: Of a core, for a step flown [s].
        learn_s: Of the learner, for a step learnt; all runners wait [s].
        step_bytes: Through the object store, for a step.
        weight_bytes: To each runner, for an iteration.
        trial_s: Of the driver, for a trial of a sweep [s].
    """

    step_s: float
    learn_s: float
    step_bytes: float
    weight_bytes: float
    trial_s: float


def main() -> None:
    """Measure, and print the tables."""
    settings = ["model=event_columns", "algo=ppo_fast", "algo.lr_schedule=constant"]
    step_bytes, weight_bytes = bytes_sent(*settings)
    rates: dict[tuple[int, int], float] = {}
    with tempfile.TemporaryDirectory() as folder:
        for nodes in (1, 2):
            with simulated(nodes, cores=2):
                for runners in (0, 1, 2, 4)[: 3 if nodes == 1 else 4]:
                    words = [*settings, f"algo.num_env_runners={runners}"]
                    rates[nodes, runners], step_s, learn_s = training_rate(*words)
                    if runners == 0:
                        alone = step_s, learn_s
        with simulated(1, cores=2):
            trial_s = trial_seconds(TRIALS, Path(folder))
    show("Training, measured", ("nodes", "env runners", "env steps/s"),
         [(n, r, f"{rate:,.0f}") for (n, r), rate in rates.items()])  # fmt: skip
    costs = Costs(*alone, step_bytes, weight_bytes, trial_s)
    show("Costs", ("of", "is"), [(name, f"{value:.3g}") for name, value in costs._asdict().items()])
    show(
        "Training, the model",
        ("cores", "env steps/s", "flying", "learning", "sending"),
        [(cores, f"{STEPS / sum(parts):,.0f}", *(f"{part / sum(parts):.0%}" for part in parts))
         for cores in CORES for parts in [iteration_s(costs, cores)]],
    )  # fmt: skip
    show(
        "A sweep, the model",
        ("cores", "conditions/h", "saturates first"),
        [(cores, f"{3600 * min(cores / CELL_S, 1 / trial_s):,.0f}",
          "cores" if cores / CELL_S < 1 / trial_s else "the driver") for cores in CORES],
    )  # fmt: skip


def iteration_s(costs: Costs, cores: int) -> tuple[float, float, float]:
    """Seconds of one PPO iteration that are spent flying, learning, and sending samples and weights.

    A core flies for each runner; one process learns while they wait, and receives all samples.
    """
    sent = STEPS * costs.step_bytes + cores * costs.weight_bytes
    return STEPS * costs.step_s / cores, STEPS * costs.learn_s, sent / BANDWIDTH


def bytes_sent(*words: str) -> tuple[float, float]:
    """Bytes of a step's sample and of the weights, as they travel between processes."""
    here = build_ppo(composed(*words, "algo.num_env_runners=0"))
    runner = PlainEnvRunner(config=here, worker_index=0)
    episodes = runner.sample(num_timesteps=STEPS)
    weights = runner.get_state(components="rl_module", inference_only=True)
    runner.stop()
    steps = sum(len(episode) for episode in episodes)
    return len(pickle.dumps(episodes, protocol=5)) / steps, float(len(pickle.dumps(weights, protocol=5)))


def training_rate(*words: str) -> tuple[float, float, float]:
    """Environment steps per second of an iteration, and its seconds flying and learning per step."""
    algorithm = build_ppo(composed(*words)).build_algo()
    algorithm.train()  # compiles
    rates, shares = [], []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        result: Any = algorithm.train()
        rates.append(STEPS / (time.perf_counter() - start))
        timers = result["timers"]
        shares.append((timers["env_runner_sampling_timer"] / STEPS, timers["learner_update_timer"] / STEPS))
    algorithm.stop()
    flying, learning = (statistics.median(column) for column in zip(*shares, strict=True))
    return statistics.median(rates), flying, learning


def trial_seconds(count: int, folder: Path) -> float:
    """Wall time of a trial that does nothing, among `count`, scheduled as the sweep's are [s]."""
    tuner = tune.Tuner(
        tune.with_resources(_nothing, {"cpu": 1}),
        tune_config=tune.TuneConfig(reuse_actors=True),
        param_space={"trial": tune.grid_search(list(range(count)))},
        run_config=tune.RunConfig(name="tune", storage_path=str(folder), verbose=0),
    )
    os.environ["TUNE_GLOBAL_CHECKPOINT_S"] = "3600"
    start = time.perf_counter()
    results = tuner.fit()
    seconds = time.perf_counter() - start
    done = sum(result.metrics is not None and "key" in result.metrics for result in results)
    if done != count:
        raise RuntimeError(f"{count} trials must report, got {done}")
    return seconds / count


def _nothing(params: dict[str, Any]) -> None:
    tune.report({"key": params["trial"]})


@contextlib.contextmanager
def simulated(nodes: int, cores: int) -> Iterator[None]:
    """A Ray of so many nodes, all on this machine, each with so many cores by its own account."""
    os.environ.update(QUIET)
    cluster = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": cores, "object_store_memory": OBJECT_STORE, "include_dashboard": False},
    )
    try:
        for _ in range(nodes - 1):
            cluster.add_node(num_cpus=cores, object_store_memory=OBJECT_STORE)
        ray.init(cluster.address, runtime_env={"env_vars": ONE_THREAD}, log_to_driver=False)
        yield
    finally:
        ray.shutdown()
        cluster.shutdown()


def show(title: str, heads: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    """Print a table."""
    table = Table(title=title)
    for head in heads:
        table.add_column(head, justify="right")
    for row in rows:
        table.add_row(*(str(value) for value in row))
    console.print(table)


if __name__ == "__main__":
    main()
