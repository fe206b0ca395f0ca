import pytest

from tests.support.configs import make_config
from tests.support.runs import write_encoder


@pytest.fixture(scope="session")
def encoder(tmp_path_factory):
    """The file of an untrained encoder; every training here starts from it and none changes it."""
    return write_encoder(tmp_path_factory.mktemp("encoder"), make_config())


@pytest.fixture
def make_runner():
    """A function that makes an env runner of an algorithm; all end with the test."""
    runners = []

    def make(built, kind=None):
        runners.append((kind or built.env_runner_cls)(config=built, worker_index=0))
        return runners[-1]

    yield make
    for runner in runners:
        runner.stop()
