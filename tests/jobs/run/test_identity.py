"""Run folders of older versions are found under the names that those versions gave them."""

import dataclasses
import json
from pathlib import Path

import pydantic.dataclasses
import pytest

from jobs.config.config import as_dict, parse
from jobs.run import identity as names
from jobs.run.files import write_json
from jobs.run.folder import open_run, run_name
from tests.support.configs import compose, small_config

# Names and config.json of run folders that the version before jobs owned their settings made.
OLDER = json.loads(Path(__file__).with_name("older_runs.json").read_text())


@pytest.mark.parametrize("run", OLDER, ids=lambda run: run["name"])
def test_a_run_folder_of_an_older_version_is_found_under_its_name(run, tmp_path):
    path = tmp_path / "runs" / run["name"]
    write_json(path / "config.json", run["config"])
    job = run["config"]["job"]
    own = {"replay": "replay", "video_events": "video"}.get(job, "")
    words = [f"{job}.{key}={value}" for key, value in run["config"].get(own, {}).items() if value]
    asked = parse(compose(f"+exp={job}" if own else "+exp=train", *words))
    found = open_run(dataclasses.replace(asked, resume=str(path)))
    assert found.path == path
    assert run_name(dataclasses.replace(found.config, resume=None)) == run["name"]


def test_a_field_that_is_added_renames_no_folder_until_it_is_changed(tmp_path, monkeypatch):
    config = small_config(tmp_path)
    usual = run_name(config)

    @pydantic.dataclasses.dataclass(frozen=True)
    class Later(type(config.env.faults)):
        blinking: float = 0.0

    monkeypatch.setitem(names.ADDED_SETTINGS, "faults", dict(names._later("faults", Later)))
    values = as_dict(config)
    for value, renamed in ((0.0, False), (0.5, True)):
        changed = {**values, "faults": {**values["faults"], "blinking": value}}
        monkeypatch.setattr(names, "as_dict", lambda config, changed=changed: changed)
        assert (run_name(config) != usual) == renamed


def test_the_settings_of_a_job_alone_do_not_name_a_training():
    alike = ("+exp=event_columns", "job=trade", "trade.trials=3"), ("+exp=event_columns", "job=search")
    assert len({run_name(parse(compose(*words))) for words in (*alike, ("+exp=event_columns",))}) == 1
