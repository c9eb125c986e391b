from tests.core.experiments.rearrangement.conftest import runs  # noqa: F401 - a fixture
