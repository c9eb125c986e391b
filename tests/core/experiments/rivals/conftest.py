from tests.core.dynamics.conftest import shapes, table  # noqa: F401 - fixtures
