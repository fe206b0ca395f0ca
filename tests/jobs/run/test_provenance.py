import sys

import pytest

from jobs.run.provenance import command


@pytest.mark.parametrize(
    ("word", "shown"),
    [
        ("study.train=false", "study.train=false"),
        ("ablation.trained=/elsewhere/work/policies", "ablation.trained=policies"),
        ("ablation.trained=../someone/work/policies", "ablation.trained=policies"),
        ("study.policies=[/elsewhere/a,models/b/c]", "'study.policies=[a,models/b/c]'"),
    ],
)
def test_the_command_keeps_paths_of_the_repository_and_tells_no_local_ones(word, shown, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["launch", "+exp=robustness", word])
    assert command() == f"python -m platform.launch +exp=robustness {shown}"
