import pytest

from tests.support.configs import make_config
from tests.support.runs import write_encoder


@pytest.fixture(scope="session")
def encoder(tmp_path_factory):
    """The file of an untrained encoder; every training here starts from it and none changes it."""
    return write_encoder(tmp_path_factory.mktemp("encoder"), make_config())
