"""The tutorial of docs/own_camera.md, command by command, on a recording of a real DAVIS240C."""

import os
import re
import shlex
import sys
from pathlib import Path

import pytest

from tests.support.started import ROOT, said

SLIDER = (Path(os.environ.get("EVADE_DATA", ROOT.parent / "shared" / "data")) / "rpg_slider_depth").absolute()
PAGE = (ROOT / "docs" / "own_camera.md").read_text()
COMMANDS = re.findall(r"^```\n(evade .*?)^```", PAGE.replace("\\\n", " "), re.MULTILINE | re.DOTALL)
SNIPPETS = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
# The camera that the page's calibration finds is in conf/; a test writes nothing there.
INSTEAD = {"camera=mine": "camera=davis240_slider", "calibrate.camera=mine": ""}

pytestmark = [
    pytest.mark.system,
    pytest.mark.slow,
    pytest.mark.skipif(not SLIDER.is_dir(), reason=f"needs the recording in {SLIDER}"),
]


def run(folder: Path, *words: str) -> str:
    """Return what a command says that is given in a folder."""
    return said(*words, cwd=folder, PYTHONPATH=str(ROOT), OMP_NUM_THREADS="1")


def evade(folder: Path, command: str) -> str:
    """Return what a command of the page says, with the smallest budget."""
    words = [INSTEAD.get(word, word) for word in shlex.split(command)[1:]]
    start = [sys.executable, "-c", "import sys, jobs; sys.argv[0] = 'evade'; sys.exit(jobs.main())"]
    return run(folder, *start, *filter(None, words), "budget=smoke")


def test_a_recording_becomes_a_camera_a_policy_and_its_actions(tmp_path):
    (tmp_path / "events.txt").symlink_to(SLIDER / "events_chunk.txt")
    for name in ("images.txt", "images"):
        (tmp_path / name).symlink_to(SLIDER / name)
    record, live = SNIPPETS
    assert "50000 events" in run(tmp_path, sys.executable, "-c", record)
    calibrate, train, replay = COMMANDS
    assert re.search(r"camera\.contrast_threshold +│ 1\.22", evade(tmp_path, calibrate))
    assert (tmp_path / "runs").is_dir()
    evade(tmp_path, train)
    (policy,) = (tmp_path / "runs").glob("bytestream_imitation-*/policy")
    assert (policy / "policy.json").is_file()
    evade(tmp_path, replay)
    (choices,) = (tmp_path / "runs").glob("replay-*/replay/choices.csv")
    assert len(choices.read_text().splitlines()) > 30
    decide = "from envs.events import EVENT\nimport numpy as np\nprint(decide(np.zeros(0, EVENT), 0) < 3)"
    assert "True" in run(tmp_path, sys.executable, "-c", live + decide)
