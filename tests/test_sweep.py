import dataclasses
import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig, FidelityConfig, sensor_settings
from jobs import sweep as sweeping
from jobs.conditions import plan, read_manifest, swept_policy, with_sensor
from jobs.config import ConfigError
from jobs.drift import FIGURES
from jobs.flights import EPISODE
from jobs.runs import open_run
from jobs.sweep import KeepEpisodes, fly_cells, read_episodes, unflown
from jobs.tracking import open_store
from models.kinds import KINDS
from tests.test_evaluate import save_untrained
from tests.test_runs import small_config

AXES = {"faults.sparsity": [0.5, 0.0], "env.control_hz": [200.0, 100.0]}


def sweep_config(tmp_path, trials=2, **changes):
    config = small_config(tmp_path, job="sweep", exp="robustness")
    settings = dataclasses.replace(config.sweep, axes=AXES, trials=trials, policy="straight", **changes)
    return dataclasses.replace(config, sweep=settings, env={**config.env, "time_limit_s": 0.2})


OTHER_CAMERA = {
    "threshold_mismatch": 0.03,
    "threshold_seed": 1,
    "response": "lin_log",
    "encoding": "linear8",
}


class StubTuner:
    """Flies in this process what Tune would fly in workers, and counts it."""

    flown: list[tuple[str, int]] = []  # noqa: RUF012

    def __init__(self, folder, missing, keep):
        self.missing, self.keep = missing, keep

    def fit(self):
        for cell in self.missing:
            rows = np.zeros(len(cell.seeds), EPISODE)
            rows["seed"], rows["distance_m"] = cell.seeds, 50.0
            self.flown += [(cell.key, seed) for seed in cell.seeds]
            result = {"key": cell.key, "label": list(cell.label), "episodes": rows.tolist()}
            result |= {"event_error": 0.01, "renders_per_step": 3.0, "encoder": {}}
            self.keep.on_trial_result(1, [], None, result)
        return type("Results", (), {"errors": []})()


@pytest.fixture
def stub(monkeypatch):
    StubTuner.flown = []
    monkeypatch.setattr(sweeping, "_tuner", StubTuner)
    monkeypatch.setattr(sweeping, "start_ray", lambda *given: None)
    return StubTuner


def test_axes_are_changed_one_at_a_time_and_share_the_unchanged_cell(tmp_path):
    sweep = plan(sweep_config(tmp_path), "straight")
    assert [value for value, _ in sweep.axes["faults.sparsity"]] == [0.0, 0.5]
    unchanged, sparse = (cell for _, cell in sweep.axes["faults.sparsity"])
    slow, paper = (cell for _, cell in sweep.axes["env.control_hz"])
    assert unchanged.key == paper.key == sweep.bounds["straight"].key
    assert sparse.env == dataclasses.replace(
        unchanged.env, faults=dataclasses.replace(unchanged.env.faults, sparsity=0.5)
    )
    assert slow.env == dataclasses.replace(unchanged.env, control_hz=100.0)
    assert len({cell.key for cell in sweep.cells()}) == 4
    assert all(cell.env.split == "eval" and cell.seeds == (0, 1) for cell in sweep.cells())


def test_a_second_run_flies_nothing_twice(tmp_path, stub):
    config = sweep_config(tmp_path)
    folder, cells = open_run(config), plan(config, "straight").cells()
    first = fly_cells(config, folder, cells)
    assert len(stub.flown) == len(set(stub.flown)) == 8
    again = fly_cells(config, folder, cells)
    assert len(stub.flown) == 8
    for key, episodes in first.items():
        np.testing.assert_array_equal(episodes, again[key])


def test_more_trials_fly_only_the_new_corridors(tmp_path, stub):
    few, many = sweep_config(tmp_path, trials=2), sweep_config(tmp_path, trials=5)
    folder = open_run(few)
    fly_cells(few, folder, plan(few, "straight").cells())
    stub.flown.clear()
    flown = fly_cells(many, folder, plan(many, "straight").cells())
    assert sorted({seed for _, seed in stub.flown}) == [2, 3, 4]
    assert all(list(episodes["seed"]) == [0, 1, 2, 3, 4] for episodes in flown.values())


def test_a_sweep_that_was_stopped_flies_what_is_missing(tmp_path, stub):
    config = sweep_config(tmp_path)
    folder, cells = open_run(config), plan(config, "straight").cells()
    fly_cells(config, folder, cells)
    kept = folder.path / "sweep" / "episodes"
    (kept / f"{cells[1].key}.json").unlink()
    stub.flown.clear()
    fly_cells(config, folder, cells)
    assert stub.flown == [(cells[1].key, 0), (cells[1].key, 1)]


def test_episodes_survive_their_file_unchanged(tmp_path):
    cell = dataclasses.replace(plan(sweep_config(tmp_path), "straight").cells()[0], seeds=(3,))
    flown = np.array([(3, True, False, False, 100.0, 200.0, 1000, 1 / 3, 2)], EPISODE)
    keep = KeepEpisodes(tmp_path)
    result = {"key": cell.key, "label": list(cell.label), "episodes": flown.tolist()}
    keep.on_trial_result(1, [], None, result | {"event_error": 0.01, "renders_per_step": 3.0, "encoder": {}})
    np.testing.assert_array_equal(read_episodes(cell, tmp_path), flown)
    assert unflown(cell, tmp_path).seeds == ()


def test_the_callback_can_be_pickled_with_its_progress_bar(tmp_path):
    keep = pickle.loads(pickle.dumps(KeepEpisodes(tmp_path, lambda count, note: None)))
    assert (keep.folder, keep.advance) == (tmp_path, None)


def test_another_policy_is_another_cell(tmp_path):
    config = sweep_config(tmp_path)
    one = save_untrained(tmp_path / "one", config.env_config())
    manifest = json.loads((one / "policy.json").read_text())
    keys = {plan(config, name).cells()[0].key for name in ("straight", "oracle", str(one))}
    (one / "policy.json").write_text(json.dumps({**manifest, "sha256": {}}))
    assert len(keys | {plan(config, str(one)).cells()[0].key}) == 4


def test_a_policy_flies_its_own_sensor_with_one_setting_changed_at_a_time(tmp_path):
    config = sweep_config(tmp_path)
    trained = config.env_config(control_hz=100.0, camera=CameraConfig(memory="frame"))
    sweep = plan(config, str(save_untrained(tmp_path / "policy", trained)))
    assert sweep.differ == {"control_hz": (100.0, 200.0), "memory": ("frame", "reference")}
    own = sensor_settings(trained)
    assert all(sensor_settings(cell.env) == own for _, cell in sweep.axes["faults.sparsity"])
    assert all(sensor_settings(cell.env) == own for cell in sweep.bounds.values())
    rates = [sensor_settings(cell.env) for _, cell in sweep.axes["env.control_hz"]]
    assert rates == [own, {**own, "control_hz": 200.0}]


def test_every_sensor_setting_of_a_manifest_reaches_the_simulation():
    changed = {"luminance_floor": 1e-2, "max_events_per_pixel": 7, "contrast_threshold_off": 0.4}
    fidelity = FidelityConfig(0.1, max_step_m=0.05, samples=3, cull_m=40.0)
    usual, differ = sensor_settings(EnvConfig()), set()
    held = EnvConfig(camera=CameraConfig(refractory_us=10))
    for exclusive in ({"memory": "frame"}, {"refractory_us": 100}, {"excess": "carry"}):
        camera = CameraConfig(32, 48, 60.0, 0.3, **OTHER_CAMERA, **changed, **exclusive)
        other = EnvConfig(camera=camera, control_hz=50.0, speed_mps=5.0, fidelity=fidelity)
        sensor = json.loads(json.dumps(sensor_settings(other)))
        differ |= {name for name in usual if sensor[name] != usual[name]}
        assert sensor_settings(with_sensor(EnvConfig(), sensor)) == sensor
        assert sensor_settings(with_sensor(held, sensor)) == sensor
    assert differ == set(usual)


def test_a_sensor_unlike_the_configured_one_is_named_in_one_line(tmp_path, capsys):
    config = sweep_config(tmp_path)
    same = str(save_untrained(tmp_path / "same", config.env_config()))
    slow = str(save_untrained(tmp_path / "slow", config.env_config(control_hz=100.0)))
    lines = {}
    for policy in (same, slow):
        sweeping.announce(policy, plan(config, policy))
        lines[policy] = capsys.readouterr().out.splitlines()
    assert lines[same] == [f"Policy: {same}, brp_full"]
    assert lines[slow][0] == f"Policy: {slow}, brp_full"
    assert lines[slow][1:] == ["Flown with the policy's own sensor: control_hz = 100.0 instead of 200.0"]


def test_a_policy_is_named_by_its_folder_or_its_run_folder(tmp_path):
    config = sweep_config(tmp_path)
    folder = open_run(config)
    policy = save_untrained(tmp_path / "runs" / "trained" / "policy", config.env_config())
    for name in (None, str(policy), str(policy.parent)):
        named = dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, policy=name))
        assert swept_policy(named, folder) == str(policy)
    nowhere = dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, policy=str(tmp_path)))
    with pytest.raises(ConfigError, match=r"sweep\.policy: must be a run folder, a policy folder or"):
        swept_policy(nowhere, folder)


def tracked_sweeps(config):
    """Client, and the children by name of each sweep's parent run."""
    client, experiment = open_store(config.tracking.uri, config.tracking.experiment)
    parents = client.search_runs([experiment], "tags.kind = 'sweep'")
    below = "tags.`mlflow.parentRunId` = '{}'"
    children = {
        run.info.run_id: client.search_runs([experiment], below.format(run.info.run_id)) for run in parents
    }
    return client, {parent: {run.info.run_name: run for run in runs} for parent, runs in children.items()}


def in_store(config, tmp_path):
    return dataclasses.replace(
        config, tracking=dataclasses.replace(config.tracking, uri=f"sqlite:///{tmp_path}/m.db")
    )


def test_a_sweep_is_one_run_with_a_child_for_each_condition_and_a_rerun_adds_no_point(tmp_path, stub):
    config = in_store(sweep_config(tmp_path), tmp_path)
    for _ in range(2):
        figures = sweeping.run(config)
    assert set(figures) == {f"{axis}={value:g}" for axis, values in AXES.items() for value in values}
    folder = open_run(config).path / "sweep"
    assert all((folder / name).is_file() for name in ("faults.sparsity.png", "table.md", "episodes.csv"))
    client, sweeps = tracked_sweeps(config)
    ((parent, children),) = sweeps.items()
    assert (
        client.get_run(parent).info.run_name
        == f"{folder.parent.name} sweep {plan(config, 'straight').identity[:8]}"
    )
    assert set(children) == set(figures)
    child = children["env.control_hz=100"].info.run_id
    assert [point.value for point in client.get_metric_history(child, "eval/distance_m")] == [50.0]
    curve = client.get_metric_history(parent, "sweep/distance_m.env.control_hz")
    assert sorted(point.step for point in curve) == [100, 200]
    table = client.download_artifacts(parent, "sweep/results.json", str(tmp_path))
    assert len(json.loads(Path(table).read_text())["data"]) == len(figures) + 2


def test_sweeps_of_other_policies_or_corridors_share_no_run_and_tell_what_differs_from_training(
    tmp_path, stub
):
    config = in_store(sweep_config(tmp_path), tmp_path)
    policy = save_untrained(tmp_path / "policy", config.env_config(control_hz=100.0))
    config = dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, policy=str(policy)))
    first = sweeping.run(config)
    manifest = read_manifest(str(policy))
    (policy / "policy.json").write_text(json.dumps({**manifest, "sha256": {}}))
    sweeping.run(config)
    sweeping.run(dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, trials=3)))
    client, sweeps = tracked_sweeps(config)
    assert len(sweeps) == 3
    for parent, children in sweeps.items():
        assert set(children) == set(first)
        assert len(client.get_metric_history(parent, "sweep/distance_m.env.control_hz")) == 2
        differ = {name: json.loads(run.data.tags["differs_from_training"]) for name, run in children.items()}
        assert differ.pop("env.control_hz=200") == {"control_hz": [100.0, 200.0]}
        assert not any(differ.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brp_full", "eip"])
def test_conditions_flown_as_tune_trials_come_back_with_the_policys_episodes(tmp_path, name):
    config = sweep_config(tmp_path)
    policy = save_untrained(tmp_path / "runs" / "trained" / "policy", config.env_config(), name)
    config = dataclasses.replace(config, sweep=dataclasses.replace(config.sweep, policy=str(policy)))
    assert set(sweeping.run(config).values()) == {0.0}
    kept = sorted((open_run(config).path / "sweep" / "episodes").glob("*.json"))
    before = [path.read_text() for path in kept]
    cells = [json.loads(text) for text in before]
    measured = [set(cell["encoder"]) for cell in cells if cell["label"][0] in AXES]
    assert measured == 3 * [set(FIGURES) if KINDS[name].encoder else set()]
    assert not any(cell["encoder"] for cell in cells if cell["label"][0] not in AXES)
    assert len(kept) == 5
    assert sweeping.run(config)
    assert [path.read_text() for path in kept] == before
