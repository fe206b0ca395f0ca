"""A plug-in of one file outside the repository: it trains, is swept and reported, and its errors name it."""

import json
import re
import sys
from pathlib import Path

import pytest

from models.policy import load_policy
from models.policy.policy import PolicyFileError
from tests.support.started import ROOT, said

pytestmark = [pytest.mark.system, pytest.mark.slow]
EVADE = Path(sys.executable).parent / "evade"
PLUGIN = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "extend.md").read_text(), re.DOTALL)[1]
TRAIN = (
    *("+exp=event_columns", "name=halves", "model.name=halves", "model.hidden=[]"),
    *("env.scene=forest", "+faults.added.blind_spot=0.3", "env.time_limit_s=1.0"),
    *("algo.train_batch_size_per_learner=256", "train.env_steps=512"),
    *("evaluate.episodes=2", "evaluate.renderers=[raycast]", "evaluate.video=false"),
)
SWEEP = (
    *("+exp=robustness", "study.policies=[newest]", "model=event_columns", "model.name=halves"),
    *("study.trials=1", "~study.axes", "env.time_limit_s=0.5"),
    "+study.axes={spot: {faults.added.blind_spot: [0.0, 0.9]}, world: {env.scene: [poles_eval, forest]}}",
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with the plug-in, in which it has been trained and evaluated."""
    folder = tmp_path_factory.mktemp("outside")
    (folder / "forest.py").write_text(PLUGIN)
    assert re.search(
        r"policy stochastic\s+│ forest\s+│ raycast\s+│\s+2 │\s+\d+ \[\d+, \d+\]", evade(folder, *TRAIN)
    )
    return folder


def evade(folder: Path, *words: str, status: int = 0) -> str:
    """What the launcher says of a command given in a folder with a plug-in."""
    return said(
        EVADE, *words, "budget=smoke", "plugins=[forest.py]", cwd=folder, status=status, PYTHONPATH=""
    )


def test_its_policy_trains_in_its_world_and_without_an_event_vae_at_once(trained):
    assert len([line for line in PLUGIN.splitlines() if line.strip()]) <= 30  # as its page says
    (run,) = (trained / "runs").glob("halves-*")
    assert {path.stem for path in (run / "stages").iterdir()} == {"train", "evaluate"}
    assert not {"data", "encoder"} & {path.name for path in run.iterdir()}
    manifest = json.loads((run / "policy" / "policy.json").read_text())
    assert (manifest["name"], manifest["world"]["scene"], manifest["stack"]) == ("halves", "forest", 3)
    assert list(manifest["plugins"]) == ["forest"]
    with pytest.raises(PolicyFileError, match=r"got 'halves'; trained with the plug-ins forest: import them"):
        load_policy(run / "policy")


def test_its_policy_scene_and_fault_are_swept_and_reported(trained):
    swept = evade(trained, *SWEEP)
    for point in (r"spot\s+│ 0\.9", r"world\s+│ forest"):
        assert re.search(point, swept), swept
    assert "Written: docs/robustness.md" in evade(trained, "+exp=report")
    assert "halves" in (trained / "docs" / "robustness.md").read_text()


def test_without_it_a_job_says_which_plug_in_is_missing(trained):
    (policy,) = (trained / "runs").glob("halves-*/policy")
    told = said(EVADE, "+exp=demo", f"demo.policy={policy}", cwd=trained, status=2)
    assert "trained with the plug-ins forest: import them first, in a job by plugins=[...]" in told


BROKEN = {
    "a network that raises": (
        "    return nn.Flatten()",
        "    1 / 0\n    return nn.Flatten()",
        "'halves' of plug-in forest: ZeroDivisionError: division by zero (plug-in forest, line",
        2,  # refused before anything starts
    ),
    "a fault that raises": (
        "    return lambda events,",
        "    return lambda events, *rest: 1 / 0\n    return lambda events,",
        "ZeroDivisionError: division by zero (plug-in forest, line",
        1,
    ),
}


@pytest.mark.parametrize("what", BROKEN)
def test_an_error_of_a_plug_in_names_it(tmp_path, what):
    before, after, message, status = BROKEN[what]
    assert PLUGIN.count(before) == 1
    (tmp_path / "forest.py").write_text(PLUGIN.replace(before, after))
    assert message in evade(tmp_path, *TRAIN, status=status)
