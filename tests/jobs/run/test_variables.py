import os

from jobs.run.variables import variables_set


def test_variables_of_a_block_are_put_back(monkeypatch):
    monkeypatch.setenv("EVADE_A", "1")
    monkeypatch.delenv("EVADE_B", raising=False)
    with variables_set({"EVADE_A": "2", "EVADE_B": "3"}):
        assert (os.environ["EVADE_A"], os.environ["EVADE_B"]) == ("2", "3")
    assert os.environ["EVADE_A"] == "1"
    assert "EVADE_B" not in os.environ
