from tests.support.clusters import cluster  # noqa: F401  a fixture
