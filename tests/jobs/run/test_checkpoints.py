import contextlib
import json
import shutil
import tempfile
from pathlib import Path

import pytest

from jobs.run.checkpoints import SEAL, UNSEALED, damage, drop_unfinished, mend, seal, unfinished
from jobs.run.files import RunError


def checkpoint(folder, number):
    path = folder / "trial" / f"checkpoint_{number:06d}"
    (path / "learner").mkdir(parents=True)
    (path / "learner" / "state.pkl").write_bytes(b"weights")
    (path / "about.json").write_text(json.dumps({"number": number}))
    seal(path)
    return path


def cut(path):
    file = path / "learner" / "state.pkl"
    file.write_bytes(file.read_bytes()[:-1])


def flip(path):
    (path / "learner" / "state.pkl").write_bytes(b"weighTs")


HARM = {
    "cut": (cut, "learner/state.pkl changed"),
    "flip": (flip, "learner/state.pkl changed"),
    "lost": (lambda path: (path / "about.json").unlink(), "about.json changed"),
    "more": (lambda path: (path / "new").touch(), "new changed"),
    "seal": (lambda path: (path / SEAL).write_text('{"about'), f"{SEAL} changed"),
}


@pytest.mark.parametrize("name", HARM)
def test_a_checkpoint_is_whole_until_anything_in_it_changes(tmp_path, name):
    harm, reason = HARM[name]
    path = checkpoint(tmp_path, 1)
    assert damage(path) is None
    harm(path)
    assert damage(path) == reason


def test_a_checkpoint_without_a_seal_is_taken_only_where_none_has_one(tmp_path):
    first, second, third = (checkpoint(tmp_path, number) for number in (1, 2, 3))
    for path in (first, third):
        (path / SEAL).unlink()
    assert damage(third) == UNSEALED
    cut(third)
    assert "(not sealed), checkpoint_000002 takes its place" in mend(third)
    assert damage(third) is None
    for path in (second, third):
        (path / SEAL).unlink()
    assert mend(third) is None
    shutil.rmtree(third)
    assert "(missing), checkpoint_000002 takes its place" in mend(third)


def test_a_damaged_checkpoint_is_replaced_by_the_newest_whole_one(tmp_path):
    paths = [checkpoint(tmp_path, number) for number in (1, 2, 3)]
    assert mend(paths[2]) is None
    cut(paths[2])
    flip(paths[1])
    assert "(learner/state.pkl changed), checkpoint_000001 takes its place" in mend(paths[2])
    assert damage(paths[2]) is None
    assert json.loads((paths[2] / "about.json").read_text()) == {"number": 1}
    assert damage(paths[0]) is None


def test_a_missing_checkpoint_is_replaced_by_one_that_is_newer(tmp_path):
    newer = checkpoint(tmp_path, 5)
    named = newer.with_name("checkpoint_000002")
    assert damage(named) == "missing"
    assert "(missing), checkpoint_000005 takes its place" in mend(named)
    assert json.loads((named / "about.json").read_text()) == {"number": 5}


def test_without_a_whole_checkpoint_the_remedy_is_said(tmp_path):
    paths = [checkpoint(tmp_path, number) for number in (1, 2)]
    cut(paths[0])
    shutil.rmtree(paths[1])
    paths[1].mkdir()
    rule = rf"\(empty\), and no other is whole; delete {tmp_path}, and the same command trains again"
    with pytest.raises(RunError, match=rule):
        mend(paths[1])


def test_an_unfinished_checkpoint_lies_beside_the_finished_ones_and_goes_by_error_too(tmp_path):
    place = tmp_path / "trial"
    for error in (None, OSError):
        with contextlib.suppress(OSError), unfinished(place) as folder:
            assert Path(folder).parent == place
            (Path(folder) / "weights").write_bytes(b"half")
            if error:
                raise error
        assert not list(place.iterdir())
    with unfinished(None) as folder:
        assert Path(folder).parent == Path(tempfile.gettempdir())
    drop_unfinished(None)
    drop_unfinished(tmp_path / "nowhere")


def test_what_a_killed_process_was_making_is_never_taken_for_a_checkpoint_and_goes(tmp_path):
    first, last = (checkpoint(tmp_path, number) for number in (1, 2))
    with unfinished(first.parent) as folder:
        left = Path(folder).with_name(f"{Path(folder).name}-killed")
    shutil.copytree(first, left)  # whole, and newer than the first
    flip(last)
    assert f"{first.name} takes its place" in mend(last)
    flip(last)
    flip(first)
    with pytest.raises(RunError, match="no other is whole"):
        mend(last)
    drop_unfinished(first.parent)
    assert sorted(first.parent.iterdir()) == [first, last]
