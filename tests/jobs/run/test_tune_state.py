import json

import pytest

from jobs.run.tune_state import KEPT, keep_state, mend_state


def write(folder, name, text):
    (folder / f"experiment_state-{name}.json").write_text(text)


def read(folder, name):
    return (folder / f"experiment_state-{name}.json").read_text()


WHOLE, NEWER = json.dumps({"trial_data": [1]}), json.dumps({"trial_data": [1, 2]})


@pytest.mark.parametrize("cut", ["", WHOLE[:-3], "[]"])
def test_a_state_that_is_cut_short_gives_way_to_the_one_kept(tmp_path, cut):
    write(tmp_path, "1", WHOLE)
    keep_state(tmp_path)
    write(tmp_path, "1", cut)
    keep_state(tmp_path)
    assert "damaged" in mend_state(tmp_path)
    assert read(tmp_path, "1") == WHOLE
    assert mend_state(tmp_path) is None


def test_the_newest_whole_state_is_kept(tmp_path):
    write(tmp_path, "1", WHOLE)
    write(tmp_path, "2", NEWER)
    assert mend_state(tmp_path) is None
    keep_state(tmp_path)
    write(tmp_path, "2", "{")
    mend_state(tmp_path)
    assert (read(tmp_path, "1"), read(tmp_path, "2")) == (WHOLE, NEWER)


def test_without_a_kept_state_the_damaged_ones_go(tmp_path):
    write(tmp_path, "1", "{")
    write(tmp_path, "2", "")
    (tmp_path / KEPT).write_text("{")
    assert "damaged" in mend_state(tmp_path)
    assert not list(tmp_path.glob("experiment_state-*"))


def test_no_states_are_left_alone(tmp_path):
    assert mend_state(tmp_path) is None
    keep_state(tmp_path)
    assert not list(tmp_path.iterdir())
