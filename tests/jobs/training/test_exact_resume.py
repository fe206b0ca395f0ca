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
from models.kinds import KINDS
from tests.support.configs import make_config
from tests.support.policies import ALIKE, TRAINED
from tests.support.runs import write_encoder, write_networks

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
    "finetuned": ["model.encoder=finetuned"],
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
    config = make_config(*OWN.get(name, [f"model={name}"]), *SMALL, *words)
    encoder = write_encoder(folder, config) if KINDS[config.model.name].encoder else None
    init = write_networks(folder / "init", config) if config.train.init else None
    return config, encoder, lambda: PPO(config=build_algorithm(config, encoder, init))


def rows(algorithm, iterations):
    """What the next iterations report, but for the time that they took."""
    results = [{**algorithm.train(), "trial_restarts": 0} for _ in range(iterations)]
    told = [read_metrics(result, 1.0, ROW) for result in results]
    return json.dumps([{name: row[name] for name in SAME} for row in told])


def saved(algorithm, folder):
    folder.mkdir()
    algorithm.save_checkpoint(str(folder))
    return folder


def learned(algorithm):
    """Weights, Adam's state and its step size, by name."""
    state = algorithm.learner_group.get_state()["learner"]
    weights, optimiser = state["rl_module"]["default_policy"], state["optimizer"]
    adam = optimiser["default_policy_default_optimizer"]["state"]
    moments = {f"{k}.{name}": value for k, part in adam["state"].items() for name, value in part.items()}
    return {**weights, **moments, "lr": np.array(adam["param_groups"][0]["lr"])}


def assert_same(mine, other):
    for name, value in learned(mine).items():
        np.testing.assert_array_equal(value, learned(other)[name], err_msg=name)


@pytest.mark.parametrize(
    ("name", "runners"),
    [
        *(pytest.param(name, 0, marks=pytest.mark.slow if name in ALIKE else ()) for name in TRAINED),
        pytest.param("finetuned", 1, marks=pytest.mark.slow),
        pytest.param("bytestream", 2, marks=pytest.mark.slow),
        pytest.param("imitation", 2, marks=pytest.mark.slow),
        ("begun", 0),
        pytest.param("privileged", 2, marks=pytest.mark.slow),
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


def test_a_training_that_is_never_saved_has_the_same_bytes(tmp_path):
    _, _, make = built(tmp_path, "event_columns")
    with torch_threads(3):  # the learner takes one, whatever the process has, and gives them back
        one, other = make(), None
        told = rows(one, 3)
        one.stop()
        assert torch.get_num_threads() == 3
        other = make()
        pieces = []
        for k in range(3):
            pieces += json.loads(rows(other, 1))
            saved(other, tmp_path / str(k))
    assert json.dumps(pieces) == told
    assert_same(one, other)
    other.stop()


def test_the_first_part_of_a_longer_training_is_a_shorter_one(tmp_path):
    (_, _, shorter), (_, _, longer) = (
        built(tmp_path, "event_columns", "algo.lr_schedule=constant", f"train.env_steps={steps}")
        for steps in (192, 384)
    )
    whole = longer()
    told = [rows(whole, 2), rows(whole, 2)]
    part = shorter()
    assert rows(part, 2) == told[0]
    checkpoint = saved(part, tmp_path / "checkpoint")  # another training in this process seeds it anew
    extended = longer()
    extended.load_checkpoint(str(checkpoint))
    assert rows(extended, 2) == told[1]
    for algorithm in (whole, part, extended):
        algorithm.stop()


@pytest.fixture
def checkpoint(tmp_path):
    """A checkpoint of a training of two iterations, and what makes the training."""
    _, _, make = built(tmp_path, "event_columns")
    algorithm = make()
    rows(algorithm, 2)
    yield saved(algorithm, tmp_path / "checkpoint"), make
    algorithm.stop()


def next_result(checkpoint, make):
    algorithm = make()
    algorithm.load_checkpoint(str(checkpoint))
    try:
        return algorithm.train()
    finally:
        algorithm.stop()


def test_a_checkpoint_of_an_earlier_version_begins_new_episodes_and_says_so(checkpoint):
    shutil.rmtree(checkpoint[0] / FOLDER)
    result = next_result(*checkpoint)
    assert "new episodes" in result[NOTICE]
    assert "earlier version" in result[NOTICE]
    assert result["num_env_steps_sampled_lifetime"] == 3 * 96


def test_a_checkpoint_of_another_layout_is_refused_with_the_remedy(checkpoint):
    about = checkpoint[0] / FOLDER / "layout.json"
    write_json(about, read_json(about) | {"layout": 2})
    with pytest.raises(
        RunError, match="layout must be 1, got 2; continue with the version that wrote it, or"
    ):
        next_result(*checkpoint)


def test_a_checkpoint_of_other_processes_is_refused(checkpoint):
    about = checkpoint[0] / FOLDER / "layout.json"
    values = json.loads(json.dumps(read_json(about)).replace('"0"', '"learner"'))
    write_json(about, values)
    with pytest.raises(RunError, match=r"must be of the processes \['0', 'learner'\], got \['learner'\]"):
        next_result(*checkpoint)


def changed(checkpoint, **arrays):
    file = checkpoint / FOLDER / "0.npz"
    with np.load(file) as before:
        after = {**before, **{name: change(before[name]) for name, change in arrays.items()}}
    np.savez(file, **after)


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({"stacks": lambda stacks: stacks + 1}, "the simulation shows something else than before"),
        ({"episode_seed": lambda seeds: seeds + 1}, "the simulation shows something else than before"),
        ({"actions_taken": lambda taken: np.array([taken.sum(), 0, 0])}, "actions must not outlast"),
    ],
)
def test_a_simulation_that_does_not_repeat_itself_begins_new_episodes_and_says_so(checkpoint, arrays, reason):
    changed(checkpoint[0], **arrays)
    result = next_result(*checkpoint)
    assert reason in result[NOTICE]
    assert result["env_runners"]["num_env_steps_sampled"] == 96


def test_an_undisturbed_training_has_no_notice(checkpoint):
    assert NOTICE not in next_result(*checkpoint)


def test_generators_go_on():
    torch.manual_seed(3)
    np.random.seed(3)  # noqa: NPY002
    np.random.normal()  # noqa: NPY002  a second normal number is kept
    kept = generators()
    drawn = [(torch.rand(3).tolist(), np.random.normal(size=3).tolist()) for _ in "ab"]  # noqa: NPY002
    set_generators(kept)
    again = [(torch.rand(3).tolist(), np.random.normal(size=3).tolist()) for _ in "ab"]  # noqa: NPY002
    assert again == drawn
