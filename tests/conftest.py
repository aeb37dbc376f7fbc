"""Settings of all tests."""

import secrets

import pytest
from hypothesis import settings

# Every run looks at new cases, in CI too; what was found once stays as an explicit example beside its test. The seed
# of a run is told in its first lines, and `pytest --hypothesis-seed=...` draws the same cases again.
settings.register_profile("fresh", derandomize=False, print_blob=True)
settings.load_profile("fresh")


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Choose the seed of all property tests, before hypothesis asks for one; workers are given that of the run."""
    if config.getoption("hypothesis_seed") is None:
        config.option.hypothesis_seed = str(secrets.randbits(32))


def pytest_report_header(config: pytest.Config) -> str:
    """Tell the seed."""
    return f"property tests: --hypothesis-seed={config.getoption('hypothesis_seed')}"
