"""The benchmark: its protocol, scores, results, their refusal, verification, and policies from elsewhere."""

import dataclasses
import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest

from envs.config import EnvConfig, hashed_settings
from jobs.bench import bench, bench_table, bench_verify
from jobs.bench.evaluated import cost_of, joined
from jobs.bench.protocol import CLEAN, PROTOCOL, met_in_training, read_protocol, tasks_of
from jobs.bench.result import Cost, RefusedResultError, read_result
from jobs.bench.score import failure_counts, score
from jobs.config.config import ConfigError, parse
from jobs.rollout.agents import make_agent
from jobs.rollout.episodes import ADDED, EPISODE, roll_out
from jobs.rollout.policies import read_foreign, read_policy
from jobs.rollout.store import PartResult
from jobs.run.files import read_json, write_json
from models.policy import PRETRAINED
from tests.support.configs import compose
from tests.support.fake_executor import FakeExecutor

ROOT = Path(__file__).resolve().parents[3]
RESULTS = ROOT / "docs" / "data" / "bench"
CELLS = 12 * 5 + 1
SHORT = EnvConfig(scene="poles_eval", split="eval", time_limit_s=0.1)


def drawn(part):
    """Episodes that depend on what decides them: the task's key, the policy and the corridor."""
    task = part.task
    episodes = np.zeros(len(task.seeds), EPISODE)
    for episode, seed in zip(episodes, task.seeds, strict=True):
        word = f"{task.key} {task.policy.identity} {seed}"
        rng = np.random.default_rng(int(hashlib.sha256(word.encode()).hexdigest()[:12], 16))
        episode["seed"], episode["success"] = seed, rng.random() < 0.6
        episode["collision"] = not episode["success"]
        episode["distance_m"], episode["steps"] = rng.uniform(0, 100), rng.integers(1, 1000)
    return PartResult(episodes, {})


@pytest.fixture
def protocol(monkeypatch):
    """The protocol, with a reference that fails a hundred times under each corruption."""
    whole = read_protocol()
    counts = {name: 100 for part in whole.parts.values() for name in part}
    known = dataclasses.replace(whole, reference={**whole.reference, "failures": counts})
    for module in (bench, bench_verify, bench_table):
        monkeypatch.setattr(module, "read_protocol", lambda: known)
    cost = Cost(bytes=None, operations_per_event=None, ms_per_decision=0.25)
    monkeypatch.setattr(bench, "cost_of", lambda *_: cost)  # which flies an episode
    return known


def configured(tmp_path, job, **own):
    values = compose(f"+exp={job}")
    return parse({**values, "runs_dir": str(tmp_path / "runs"), job: {**values[job], **own}})


@pytest.fixture
def result(protocol, tmp_path):
    """The file of a result of `straight`, and what computed it."""
    executor = FakeExecutor(drawn)
    bench.run(configured(tmp_path, "bench", policy="random", source="here"), executor)
    (file,) = (tmp_path / "runs").glob("*/bench/*.json")
    return file, executor


def test_the_protocol_names_its_bytes_and_each_corruption_rises_in_five_severities():
    protocol = read_protocol()
    assert protocol.sha256 == hashlib.sha256(PROTOCOL.read_bytes()).hexdigest()
    assert len(protocol.cells("C")) == CELLS
    for name, axis in protocol.parts["C"].items():
        moving = [values for values in axis.values() if len(values) == 5]
        assert moving, name
        assert all(values in (sorted(values), sorted(values, reverse=True)) for values in moving), name


def test_every_corridor_of_every_cell_is_evaluated_once_and_takes_its_turn():
    tasks = tasks_of(read_protocol(), "C", read_policy("straight"), "stochastic")
    for cell, group in tasks.items():
        assert sorted(seed for task in group for seed in task.seeds) == list(range(50)), cell
    at_100, at_120 = tasks["flicker", 3]
    assert (at_100.env.faults.flicker_hz, at_120.env.faults.flicker_hz) == (100.0, 120.0)
    assert at_100.seeds == tuple(range(0, 50, 2))
    whole = joined(task for group in tasks.values() for task in group)
    assert len({task.key for task in whole}) == len(whole) == 6  # it sees no fault, and may come late


def test_each_corruption_changes_its_own_settings_alone():
    protocol = read_protocol()
    nominal = hashed_settings(protocol.env)
    tasks = tasks_of(protocol, "C", read_policy("models/pretrained/bytestream-s0"), "stochastic")
    for (name, severity), group in tasks.items():
        for task in group:
            changed = dataclasses.replace(task.env, filter_support=0)
            assert (hashed_settings(changed) == nominal) == (severity == 0), name
            assert (task.env.scene, task.env.control_hz, task.env.split) == ("poles_eval", 200.0, "eval")


def cells_of(rates, seed=0):
    """Fifty episodes of each cell, of which these shares succeed."""
    rng, found = np.random.default_rng(seed), {}
    for cell, rate in rates.items():
        found[cell] = np.zeros(50, EPISODE)
        found[cell]["seed"], found[cell]["success"] = np.arange(50), rng.random(50) < rate
    return found


RATES = {(CLEAN, 0): 0.9} | {(name, k): 0.9 - 0.15 * k for name in ("a", "b", "c") for k in range(1, 6)}


def test_the_reference_has_an_error_of_one_none_one_of_zero_and_one_failure_more_its_part_of_one():
    cells = cells_of(RATES)
    counts = failure_counts(cells)
    before, perfect = score([cells], counts), score([cells_of(dict.fromkeys(RATES, 2.0))], counts)
    assert (before.mce, set(before.errors.values()), before.worst_cell[1]) == (1.0, {1.0}, 5)
    assert (perfect.mce, perfect.interval) == (0.0, (0.0, 0.0))
    place = int(cells["b", 1]["success"].argmax())
    cells["b", 1]["success"][place] = False
    after = score([cells], counts)
    assert after.errors == pytest.approx({"a": 1.0, "b": 1.0 + 1 / counts["b"], "c": 1.0}, rel=1e-12)
    assert after.mce == pytest.approx(1.0 + 1 / counts["b"] / 3, rel=1e-12)
    assert after.clean == before.clean
    with pytest.raises(ValueError, match=r"\['b'\]"):  # a reference that never fails
        score([cells], {**counts, "b": 0})


def test_the_interval_of_several_trainings_holds_the_mean_of_most_draws():
    reference, inside = dict.fromkeys(("a", "b", "c"), 150), 0
    true = sum(50 * (1 - rate) for (name, _), rate in RATES.items() if name != CLEAN) / 150 / 3
    for draw in range(40):
        trainings = [cells_of(RATES, seed=100 * draw + k) for k in range(3)]
        low, high = score(trainings, reference).interval
        inside += low <= true <= high
    assert inside >= 35


def test_a_result_is_read_as_it_was_written_and_a_second_run_evaluates_nothing(protocol, result, tmp_path):
    file, executor = result
    read = read_result(file, protocol)
    assert (read.result.name, read.result.source, read.result.kind) == ("random-C", "here", "baseline")
    assert sum(rows.size for rows in read.episodes.values()) == CELLS * 50
    before = file.read_bytes(), file.with_suffix(".csv").read_bytes(), len(executor.evaluated)
    bench.run(configured(tmp_path, "bench", policy="random", source="here"), executor)
    assert len(executor.evaluated) == before[2]
    assert file.with_suffix(".csv").read_bytes() == before[1]


@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_a_result_with_one_digit_changed_is_refused(protocol, result, suffix):
    file = result[0].with_suffix(suffix)
    text, rng = file.read_text(), np.random.default_rng(0)
    digits = [match.start() for match in re.finditer(r"\d", text)]
    for place in rng.choice(digits, 10, replace=False):
        other = str((int(text[place]) + 1) % 10)
        file.write_text(text[:place] + other + text[place + 1 :])
        with pytest.raises(RefusedResultError):
            read_result(result[0], protocol)


NAN = re.compile(r"(leak,2,3,\w+,\w+,\w+,)[\d.]+")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: text.replace("invented_events,1,7,", "invented_events,1,8,", 1), "corridors 0 to 49"),
        (lambda text: text.rsplit("\n", 2)[0] + "\n", "corridors 0 to 49"),
        (lambda text: text.replace("invented_events,1,", "invented,1,", 1), "must be an episode"),
        (lambda text: NAN.sub(r"\1nan", text), "must be an episode"),
        (lambda text: text.replace("Severity", "Strength", 1), "columns"),
        (lambda text: text.replace("False,True,", "True,False,", 1), "clean must be"),
    ],
)
def test_a_table_that_lacks_an_episode_or_has_others_than_its_scores_is_refused(
    protocol, result, change, said
):
    """Whoever changes an episode can change the checksums, too."""
    table = result[0].with_suffix(".csv")
    table.write_text(change(table.read_text()))
    checksum = hashlib.sha256(table.read_bytes()).hexdigest()
    write_json(result[0], read_json(result[0]) | {"episodes": checksum})
    with pytest.raises(RefusedResultError, match=said):
        read_result(result[0], protocol)


def test_a_result_from_before_a_column_of_episodes_is_read_with_its_default(protocol, result, monkeypatch):
    table = result[0].with_suffix(".csv")
    table.write_text("".join(line.rpartition(",")[0] + "\n" for line in table.read_text().splitlines()))
    checksum = hashlib.sha256(table.read_bytes()).hexdigest()
    write_json(result[0], read_json(result[0]) | {"episodes": checksum})
    with pytest.raises(RefusedResultError, match="columns"):
        read_result(result[0], protocol)
    monkeypatch.setitem(ADDED, "dropped", 7)
    assert all((rows["dropped"] == 7).all() for rows in read_result(result[0], protocol).episodes.values())


def test_a_result_of_another_protocol_or_with_more_or_less_than_the_schema_is_refused(protocol, result):
    with pytest.raises(RefusedResultError, match="protocol must be"):
        read_result(result[0], dataclasses.replace(protocol, sha256="0" * 64))
    values = read_json(result[0])
    for change in ({**values, "more": 1}, {name: values[name] for name in values if name != "mce"}):
        result[0].write_text(json.dumps({name: change[name] for name in change if name != "checksum"}))
        with pytest.raises(RefusedResultError):
            read_result(result[0], protocol)


def verify(tmp_path, file, executor, **own):
    return bench_verify.run(configured(tmp_path, "bench_verify", result=str(file), **own), executor)


def test_verification_repeats_a_twentieth_drawn_anew_and_accepts_equal_bytes(protocol, result, tmp_path):
    once, again = FakeExecutor(drawn), FakeExecutor(drawn)
    for executor in (once, again):
        assert verify(tmp_path, result[0], executor) == {"repeated": 153.0}
        assert len(executor.evaluated) <= 153  # cells that are one simulation share their episodes
    assert once.evaluated != again.evaluated


def test_verification_refuses_one_byte_and_another_policy(protocol, result, tmp_path):
    def other(part):
        found = drawn(part)
        found.episodes["distance_m"] = np.nextafter(found.episodes["distance_m"], 1e9)
        return found

    with pytest.raises(RefusedResultError, match="distance_m"):
        verify(tmp_path, result[0], FakeExecutor(other))
    with pytest.raises(RefusedResultError, match="is of policy random, got straight"):
        verify(tmp_path, result[0], FakeExecutor(drawn), policy="straight")


def test_verification_asks_for_the_place_of_a_function_and_says_where_it_is_from(tmp_path):
    rule = r"'sb3_ppo' \(by docs/entries/sb3_ppo\).*evade bench verify .* PLACE"
    with pytest.raises(ConfigError, match=rule):
        verify(tmp_path, RESULTS / "sb3_ppo-C.json", FakeExecutor(drawn))


def test_the_leaderboard_has_the_best_first_and_refuses_what_is_forged(protocol, result, tmp_path):
    folder, executor = result[0].parent, FakeExecutor(drawn)
    bench.run(configured(tmp_path, "bench", policy="straight", name="ahead", met=["leak"]), executor)
    assert bench_table.run(configured(tmp_path, "bench_table", folder=str(folder))) == {"results": 2.0}
    (own,) = bench_table.entries(folder, protocol).values()
    assert [entry.scores.mce for entry in own] == sorted(entry.scores.mce for entry in own)
    text = (folder / "leaderboard.md").read_text()
    assert protocol.sha256 in text
    assert re.search(r"`ahead`.*leak", text)
    assert (folder / "leaderboard_C.png").stat().st_size > 10_000
    for suffix in (".json", ".csv"):
        (folder / f"ahead-C{suffix}").rename(folder / f"best-C{suffix}")
    for place, rule in ((folder, r"must be called ahead-C\.json"), (tmp_path, "holds no JSON file")):
        with pytest.raises(RefusedResultError, match=rule):
            bench_table.entries(place, protocol)


def test_a_corruption_is_met_where_training_drew_a_severity_of_it_whatever_all_severities_share(protocol):
    policy = read_policy(str(PRETRAINED / "bytestream_hold-s0"))  # up to 7 Hz of noise, all pixels alike
    assert met_in_training(protocol, "C", policy) == ["invented_events", "pixel_noise", "hot_pixels"]
    assert met_in_training(protocol, "C", read_policy(str(PRETRAINED / "bytestream-s0"))) == []


def test_a_corruption_or_a_policy_from_elsewhere_that_does_not_exist_is_refused(protocol, tmp_path):
    with pytest.raises(ConfigError, match=r"bench\.met"):
        bench.run(configured(tmp_path, "bench", policy="straight", met=["rain"]), FakeExecutor(drawn))
    for name in ("missing.onnx", "json:dumps_nothing", "no_such_module_at_all:policy"):
        with pytest.raises(ConfigError, match=r"policy|plugins"):
            read_foreign(name)


TURNING = """
def policy(seed):
    seen = []
    def act(image):
        assert image.shape == (64, 64, 1)
        seen.append(image)
        return (seed + len(seen)) % 3
    return act
"""


def test_a_function_acts_in_its_own_episode_alone(tmp_path):
    file = tmp_path / "turning_policy.py"
    file.write_text(TURNING)
    policy = read_foreign(f"{file}:policy")
    assert (policy.group, policy.observation) == ("policy", "event_image")
    together = roll_out(make_agent(policy.agent), SHORT, (0, 1, 2))
    alone = np.concatenate([roll_out(make_agent(policy.agent), SHORT, (seed,)) for seed in (0, 1, 2)])
    assert together.tobytes() == alone.tobytes()
    assert len(set(together["x_m"])) == 3


def test_the_identity_of_a_function_in_a_folder_is_that_of_its_weights_too(tmp_path):
    code = "from pathlib import Path\nACTION = int(Path(__file__).with_name('weights').read_text())\n"
    seen = []
    for action in (1, 2):
        folder = tmp_path / str(action) / f"weighed_{action}"
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text(code + "def policy(seed):\n    return lambda image: ACTION\n")
        (folder / "weights").write_text(str(action))
        seen.append(read_foreign(f"{folder}:policy"))
    sizes = [file.stat().st_size for file in folder.iterdir() if file.is_file()]
    assert cost_of(seen[1], "stochastic", SHORT).bytes == sum(sizes)
    first, second = (roll_out(make_agent(policy.agent), SHORT, (0,)) for policy in seen)
    assert first["x_m"] < second["x_m"]
    (folder / "weights").write_text("1")
    assert len({*(policy.identity for policy in seen), read_foreign(f"{folder}:policy").identity}) == 3


@pytest.mark.system
@pytest.mark.parametrize(
    "folder", sorted((ROOT / "docs" / "entries").glob("[a-z]*/")), ids=lambda folder: folder.name
)
def test_an_entry_decides_in_a_process_that_did_not_train_it(folder):
    pytest.importorskip("stable_baselines3", reason="needs the extra dev")
    episodes = roll_out(make_agent(read_foreign(f"{folder}:policy").agent), SHORT, (0,))
    assert episodes["x_m"] > 0.0


def test_a_policy_costs_its_files_and_two_operations_a_feature_and_event():
    policy = read_policy(str(PRETRAINED / "bytestream-s0"))
    cost = cost_of(policy, "stochastic", SHORT)
    assert cost.bytes == sum(file.stat().st_size for file in (PRETRAINED / "bytestream-s0").iterdir())
    assert cost.operations_per_event == 2 * 256
    assert cost.ms_per_decision > 0.0
    assert cost_of(read_policy("straight"), "stochastic", SHORT).bytes is None


@pytest.mark.system  # six seconds of export
def test_an_onnx_file_of_a_policy_flies_as_the_policy_does(tmp_path):
    pytest.importorskip("onnxruntime", reason="needs the extra onnx")
    pytest.importorskip("onnxscript", reason="needs the extra onnx")
    from models.policy import load_policy
    from models.policy.onnx import export_onnx

    folder = PRETRAINED / "event_columns-s0"
    file = export_onnx(load_policy(folder), tmp_path / "columns.onnx")
    seen = read_foreign(str(file))
    assert (seen.observation, seen.group) == ("window", "columns")
    theirs = roll_out(make_agent(str(folder), "stochastic"), SHORT, (0, 1, 2))
    assert roll_out(make_agent(str(file), "stochastic"), SHORT, (0, 1, 2)).tobytes() == theirs.tobytes()


def test_every_submission_in_the_repository_agrees_with_itself_and_with_the_protocol():
    for file in sorted(RESULTS.glob("*.json")):
        assert read_result(file, read_protocol()).result.name == file.stem
