"""Where checkpoints are made, and what is left of those that were not finished."""

import tempfile
from pathlib import Path

import pyarrow.fs
import pytest

from jobs.run.checkpoints import mend, seal
from jobs.training.ppo import algorithm
from jobs.training.trainable import Trainable
from tests.support.runs import trial_storage


class Small(Trainable):
    """Of a single weight; notes where its checkpoints are made, and may meet a full disk."""

    full = False
    _last_result = None

    def __init__(self, storage):
        self._storage, self.made_in = storage, []

    def save_checkpoint(self, checkpoint_dir):
        self.made_in.append(Path(checkpoint_dir))
        (Path(checkpoint_dir) / "weight").write_bytes(b"1")
        if self.full:
            raise OSError(28, "No space left on device")


def test_a_checkpoint_is_made_beside_the_finished_ones(tmp_path):
    one, place = Small(trial_storage(tmp_path)), tmp_path / "train" / "trial"
    for number in range(2):
        kept = Path(one.save().checkpoint.path)
        assert kept == place / f"checkpoint_{number:06d}"
        assert (kept / "weight").read_bytes() == b"1"
        seal(kept)
        assert mend(kept) is None
    assert {folder.parent for folder in one.made_in} == {place}
    assert [path.name for path in sorted(place.iterdir())] == ["checkpoint_000000", "checkpoint_000001"]


def test_a_save_that_fails_leaves_nothing(tmp_path):
    one = Small(trial_storage(tmp_path))
    one.full = True
    with pytest.raises(OSError, match="No space left"):
        one.save()
    assert one.made_in[0].parent == tmp_path / "train" / "trial"
    assert not list(one.made_in[0].parent.iterdir())


def test_a_checkpoint_for_an_object_store_is_made_in_the_temporary_folder(tmp_path):
    store = pyarrow.fs.SubTreeFileSystem(str(tmp_path), pyarrow.fs.LocalFileSystem())
    one = Small(trial_storage("bucket", store))
    one.save()
    assert one.made_in[0].parent == Path(tempfile.gettempdir())
    assert not one.made_in[0].exists()
    kept = tmp_path / "bucket" / "train" / "trial" / "checkpoint_000000"
    assert (kept / "weight").read_bytes() == b"1"


def test_without_tune_a_checkpoint_is_where_it_was_asked_for(tmp_path):
    one = Small(None)
    assert one.save(str(tmp_path)).checkpoint.path == str(tmp_path)
    assert one.made_in == [tmp_path]


def test_what_a_killed_process_was_making_goes_when_the_training_starts_again(tmp_path, monkeypatch):
    monkeypatch.setattr(algorithm.RLlibPPO, "setup", lambda self, config: None)
    monkeypatch.setattr(algorithm, "Rounds", lambda group: None)
    ppo, place = object.__new__(algorithm.PPO), tmp_path / "train" / "trial"
    ppo.env_runner_group = None
    for name in (".checkpoint-killed", "checkpoint_000000"):
        (place / name / "learner").mkdir(parents=True)
    ppo.setup(None)  # without Tune there is nothing to look for
    assert len(list(place.iterdir())) == 2
    ppo._storage = trial_storage(tmp_path)
    ppo.setup(None)
    assert ppo._refused is None
    assert [path.name for path in place.iterdir()] == ["checkpoint_000000"]
