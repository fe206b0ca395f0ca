import pytest

from tests.support.clusters import RATES, cluster  # noqa: F401  a fixture
from tests.support.faults import launch


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """A sweep that nothing happened to, on this machine."""
    job = launch(tmp_path_factory.mktemp("undisturbed"), *RATES)
    assert job.end() == 0, job.said
    return job
