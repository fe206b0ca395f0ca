import json

import numpy as np
import pytest

from jobs.tools import fingerprint
from jobs.tools.fingerprint import FingerprintError, digest, run, versions

STAGES = {"pictures": [np.arange(3)], "events": [np.ones(2, np.float32)], "weights": [np.zeros(4)]}


@pytest.fixture
def published(tmp_path, monkeypatch):
    path = tmp_path / "fingerprints.json"
    monkeypatch.setattr(fingerprint, "PUBLISHED", path)
    monkeypatch.setattr(fingerprint, "stages", lambda config: iter(STAGES.items()))
    return path


def test_a_fingerprint_that_is_not_published_is_written_and_then_equal(published, capsys):
    found = run(None)
    assert found == {name: digest(arrays) for name, arrays in STAGES.items()}
    kept = json.loads(published.read_text())
    assert (kept["stages"], kept["versions"]) == (found, versions())
    assert run(None) == found
    assert capsys.readouterr().out.rstrip().endswith("equal")


def test_the_first_stage_that_differs_is_named(published, monkeypatch):
    run(None)
    other = {**STAGES, "events": [np.nextafter(STAGES["events"][0], np.float32(2))], "weights": [np.ones(4)]}
    monkeypatch.setattr(fingerprint, "stages", lambda config: iter(other.items()))
    with pytest.raises(FingerprintError, match=r"differ from stage 'events' on$"):
        run(None)


def test_a_digest_is_of_all_bytes_in_their_order():
    a, b = np.arange(6).reshape(2, 3), np.float32(1.0)
    assert digest([a, b]) == digest([a.copy(order="F"), b]) != digest([b, a])
    assert digest([a]) != digest([-a])
    assert len(digest([])) == 16
