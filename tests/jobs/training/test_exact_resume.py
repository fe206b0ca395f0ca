import json
import shutil

import numpy as np
import pytest
import ray
import torch
from safetensors.numpy import load_file

from core.places import resolve
from jobs.config.algorithms import ALGORITHMS
from jobs.run.files import RunError, read_json, write_json
from jobs.run.ray_cluster import start_ray
from jobs.run.torch_threads import torch_threads
from jobs.training.algorithms import build_algorithm
from jobs.training.ppo.algorithm import NOTICE, PPO
from jobs.training.ppo.train import FIGURES, LOSSES
from jobs.training.sampling.snapshots import FOLDER, generators, set_generators
from jobs.training.train import METRICS, export_policy, read_metrics
from tests.support.configs import make_config
from tests.support.learners import MODULE, encoder_of, words_of
from tests.support.runs import write_networks

pytestmark = pytest.mark.system
# Episodes of 40 steps in rounds of 32: at any time some are under way, and others have ended.
SMALL = (
    "env.time_limit_s=0.2",
    "algo.num_envs_per_env_runner=3",
    "algo.train_batch_size_per_learner=96",
    "algo.num_epochs=2",
)
IMITATION = (
    *("algo=imitation", "algo.mirrored=true", "model=event_columns"),
    *("algo.imitation.fit_steps=5", "algo.minibatch_size=32"),
)
PRIVILEGED = ("model=event_columns", "algo.critic=teacher", "algo.shaping=10")
BEGUN = ("model=event_columns", "train.init=X", "train.value_warmup=700")  # eight iterations
OWN = {
    "gru": ["model=event_columns_gru", "model.own_actions=true", "model.own_velocity=true"],
    "imitation": IMITATION,
    "privileged": PRIVILEGED,
    "begun": BEGUN,
}
ROW = resolve(ALGORITHMS["ppo"].algorithm)
SAME = [name for name in [*METRICS, *LOSSES, *FIGURES] if not name.startswith("perf/")]
CONDITIONS = "train.conditions=[{},{faults.sparsity:0.5},{env.control_hz:100}]"


@pytest.fixture(scope="module", autouse=True)
def a_ray(tmp_path_factory):
    """One for the module: RLlib starts it even for a training without processes of its own."""
    start_ray(make_config("cluster.num_cpus=4").cluster, tmp_path_factory.mktemp("ray"))
    yield
    ray.shutdown()


def built(folder, name, *words):
    """The configuration of a small training, its encoder file, and a function that makes it."""
    config = make_config(*OWN.get(name, words_of(name)), *SMALL, *words)
    encoder = encoder_of(config, folder)
    init = write_networks(folder / "init", config) if config.train.init else None
    return config, encoder, lambda: PPO(config=build_algorithm(config, encoder, init))


def rows(algorithm, iterations):
    """What the next undisturbed iterations report, but for the time that they took."""
    results = [{**algorithm.train(), "trial_restarts": 0} for _ in range(iterations)]
    assert not any(NOTICE in result for result in results)
    told = [read_metrics(result, 1.0, ROW) for result in results]
    return json.dumps([{name: row[name] for name in SAME} for row in told])


def saved(algorithm, folder):
    folder.mkdir()
    algorithm.save_checkpoint(str(folder))
    return folder


def learned(algorithm):
    """Weights, Adam's state and its step size, by name."""
    state = algorithm.learner_group.get_state()["learner"]
    weights, optimiser = state["rl_module"][MODULE], state["optimizer"]
    adam = optimiser[f"{MODULE}_default_optimizer"]["state"]
    moments = {f"{k}.{name}": value for k, part in adam["state"].items() for name, value in part.items()}
    return {**weights, **moments, "lr": np.array(adam["param_groups"][0]["lr"])}


def assert_same(mine, other):
    for name, value in learned(mine).items():
        np.testing.assert_array_equal(value, learned(other)[name], err_msg=name)


@pytest.mark.parametrize(
    ("name", "runners"),
    [
        *(("bytestream", 0), ("gru", 0), ("rgb", 0), ("begun", 0), ("imitation", 0)),
        *(
            pytest.param(name, count, marks=pytest.mark.slow)
            for name, count in (("finetuned", 1), ("bytestream", 2), ("imitation", 2), ("privileged", 2))
        ),
    ],
)
def test_a_training_goes_on_from_its_checkpoint_with_the_same_bytes(name, runners, tmp_path):
    words = CONDITIONS, "algo.lr_schedule=linear", f"algo.num_env_runners={runners}"
    config, encoder, make = built(tmp_path, name, *words)
    whole = make()
    # A drift is measured soon after seven, of windows met before, and the value's warm-up ends after eight.
    first, then = (7, 5) if encoder or config.train.init else (2, 2)
    rows(whole, first)
    checkpoint = saved(whole, tmp_path / "checkpoint")
    expected = rows(whole, then)
    again = make()
    torch.manual_seed(123)
    again.load_checkpoint(str(checkpoint))
    assert rows(again, then) == expected
    assert_same(whole, again)
    exported = [tmp_path / "one", tmp_path / "other"]
    for algorithm, target in zip((whole, again), exported, strict=True):
        end = saved(algorithm, tmp_path / f"end-{target.name}")
        export_policy(config, end, encoder, target, {})
        algorithm.stop()
    files = [sorted(path.glob("*.safetensors")) for path in exported]
    assert [path.read_bytes() for path in files[0]] == [path.read_bytes() for path in files[1]]
    assert any(np.any(value) for path in files[0] for value in load_file(path).values())


def test_the_first_part_of_a_longer_training_is_a_shorter_one_however_often_it_is_saved(tmp_path):
    shorter, longer = (
        built(tmp_path, "event_columns", "algo.lr_schedule=constant", f"train.env_steps={steps}")[2]
        for steps in (192, 384)
    )
    with torch_threads(3):  # the learner takes one, whatever the process has, and gives them back
        whole = longer()
        told = [rows(whole, 1), rows(whole, 1), rows(whole, 2)]
        assert torch.get_num_threads() == 3
        part = shorter()
        for number in range(2):
            assert rows(part, 1) == told[number]
            checkpoint = saved(part, tmp_path / str(number))
    extended = longer()  # another training in this process seeds it anew
    extended.load_checkpoint(str(checkpoint))
    assert rows(extended, 2) == told[2]
    assert_same(whole, extended)
    for algorithm in (whole, part, extended):
        algorithm.stop()


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A checkpoint of a training of two iterations, and what makes the training."""
    folder = tmp_path_factory.mktemp("kept")
    _, _, make = built(folder, "event_columns")
    algorithm = make()
    rows(algorithm, 2)
    yield saved(algorithm, folder / "checkpoint"), make
    algorithm.stop()


def next_result(kept, folder, harm):
    """What the training reports next that goes on from a copy of the checkpoint, after some harm to it."""
    checkpoint = shutil.copytree(kept[0], folder / "checkpoint")
    harm(checkpoint / FOLDER)
    algorithm = kept[1]()
    algorithm.load_checkpoint(str(checkpoint))
    try:
        return algorithm.train()
    finally:
        algorithm.stop()


def of_another_layout(snapshots):
    about = snapshots / "layout.json"
    write_json(about, read_json(about) | {"layout": 2})


def of_other_processes(snapshots):
    about = snapshots / "layout.json"
    write_json(about, json.loads(json.dumps(read_json(about)).replace('"0"', '"learner"')))


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (of_another_layout, "layout must be 1, got 2; continue with the version that wrote it, or"),
        (of_other_processes, r"must be of the processes \['0', 'learner'\], got \['learner'\]"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused(kept, tmp_path, harm, words):
    with pytest.raises(RunError, match=words):
        next_result(kept, tmp_path, harm)


def changed(**arrays):
    def harm(snapshots):
        with np.load(snapshots / "0.npz") as before:
            after = {**before, **{name: change(before[name]) for name, change in arrays.items()}}
        np.savez(snapshots / "0.npz", **after)

    return harm


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (shutil.rmtree, "the checkpoint is of an earlier version"),
        (changed(episode_seed=lambda seeds: seeds + 1), "the simulation shows something else than before"),
        (changed(actions_taken=lambda taken: np.array([taken.sum(), 0, 0])), "actions must not outlast"),
    ],
)
def test_what_cannot_be_repeated_begins_with_new_episodes_and_says_so(kept, tmp_path, harm, reason):
    result = next_result(kept, tmp_path, harm)
    assert "new episodes" in result[NOTICE]
    assert reason in result[NOTICE]
    assert result["env_runners"]["num_env_steps_sampled"] == 96
    assert result["num_env_steps_sampled_lifetime"] == 3 * 96


def test_generators_go_on():
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    np.random.normal()  # noqa: NPY002  a second normal number is kept
    kept = generators()
    drawn = [(torch.rand(3).tolist(), np.random.normal(size=3).tolist()) for _ in "ab"]  # noqa: NPY002
    set_generators(kept)
    again = [(torch.rand(3).tolist(), np.random.normal(size=3).tolist()) for _ in "ab"]  # noqa: NPY002
    assert again == drawn
