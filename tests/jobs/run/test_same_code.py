import shutil

from jobs.run import same_code
from jobs.run.same_code import ROOMS, differences, fingerprint

HERE = {"evade": "0a1b", "numba": "0.68.1", "numpy": "2.4.6", "torch": "2.13.0"}


def test_each_machine_that_is_not_as_this_one_is_named_with_what_it_has_and_the_remedy():
    answers = {
        "10.0.0.1": dict(HERE),
        "10.0.0.2": {**HERE, "evade": "ffff", "torch": "2.12.0"},
        "10.0.0.3": "ModuleNotFoundError: No module named 'jobs'",
        "10.0.0.4": {"evade": "0a1b"},
    }
    second, third, fourth = differences(HERE, answers)
    assert "10.0.0.2 must have the code and packages of this machine, got evade ffff (here 0a1b), " in second
    assert second.endswith("torch 2.12.0 (here 2.13.0); install the same commit and lock file")
    assert "10.0.0.3 cannot run this package (ModuleNotFoundError: No module named 'jobs'); " in third
    assert "numpy None (here 2.4.6)" in fourth


def test_the_fingerprint_tells_any_change_of_the_code_and_nothing_else(tmp_path, monkeypatch):
    ignore = shutil.ignore_patterns("pretrained")
    for room in ROOMS:
        shutil.copytree(same_code.REPOSITORY / room, tmp_path / room, ignore=ignore)
    here = fingerprint()
    monkeypatch.setattr(same_code, "REPOSITORY", tmp_path)
    assert fingerprint() == here
    (tmp_path / "jobs" / "notes.txt").write_text("not code")
    file = tmp_path / "envs" / "checks.py"
    before = file.read_bytes()
    file.write_bytes(before + b"\n")
    assert fingerprint()["evade"] != here["evade"]
    file.write_bytes(before)
    assert fingerprint() == here
    (tmp_path / "models" / "kinds.py").rename(tmp_path / "models" / "sorts.py")
    assert fingerprint()["evade"] != here["evade"]
