"""Settings of all tests: how many processes run them, which ones, and what they draw at random.

A run of all files takes one in four of the tests marked dear, each run others; ``--all`` takes every one.
"""

import os
import secrets
import signal
import zlib
from typing import Any

# Each process of the tests has a core of its own. NumPy reads this when it is first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
from hypothesis import is_hypothesis_test, settings

# A shell starts what it runs in the background deaf to interrupts, and programs that tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("property", derandomize=False, print_blob=True)
settings.load_profile("property")


FEW = 4
"""Of the dear tests a run of all files takes one in that many."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options that choose tests and their random cases."""
    parser.addoption("--all", action="store_true", help=f"Take all dear tests, not one in {FEW} by the seed")
    parser.addoption(
        "--seed", type=int, metavar="N", help="Draw the random cases of seed N, which an earlier run has told"
    )
    parser.addoption(
        "--one-in",
        type=int,
        default=1,
        metavar="N",
        help="Of the tests that draw random cases take one in N, which the seed chooses, and those marked anew",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Choose the seed of the run, unless it is given, before hypothesis asks for it; workers are given the run's."""
    option = config.option
    if option.seed is None:
        option.seed = getattr(config, "workerinput", {}).get("seed", secrets.randbits(32))
    if option.hypothesis_seed is None:
        option.hypothesis_seed = str(option.seed)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Give a worker the seed of the run."""
    node.workerinput["seed"] = node.config.option.seed


def pytest_report_header(config: pytest.Config) -> str:
    """Tell the seed: what a run finds is found again with it."""
    return f"random cases: --seed={config.option.seed} draws them again"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Tell the seed once more beside what failed; a quiet run has no header."""
    if terminalreporter.stats.get("failed") or terminalreporter.stats.get("error"):
        terminalreporter.write_line(pytest_report_header(config))


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Use all cores; for files and tests that are named, and for what is printed by ``-s``, this process alone."""
    if are_files_named(config) or config.option.capture == "no":
        return 0
    cores = os.environ.get("PYTEST_XDIST_AUTO_NUM_WORKERS", "")
    if cores.isdigit():
        return int(cores)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def are_files_named(config: pytest.Config) -> bool:
    """Return whether files or tests are named, rather than folders or nothing."""
    return config.args_source is pytest.Config.ArgsSource.ARGS and all(".py" in each for each in config.args)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests that draw new cases in each run, for ``-m property``, and leave out those not chosen."""
    for item in items:
        if isinstance(item, pytest.Function) and (is_hypothesis_test(item.obj) or "rng" in item.fixturenames):
            item.add_marker("property")
    option = config.option
    is_plain = not (option.all or option.markexpr or option.keyword or are_files_named(config))
    shares = {"property": option.one_in, "dear": FEW if is_plain else 1}
    left_out = [item for item in items if not all(is_chosen(item, *share) for share in shares.items())]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in set(left_out)]


def is_chosen(item: pytest.Item, marker: str, one_in: int) -> bool:
    """Return whether a test is taken, if of those with a `marker` the seed chooses `one_in` that many."""
    if not item.get_closest_marker(marker) or (marker == "property" and item.get_closest_marker("anew")):
        return True
    return (zlib.crc32(item.nodeid.encode()) + item.config.option.seed) % one_in == 0


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Return random numbers that are new in each run and in each test."""
    return np.random.default_rng([request.config.option.seed, zlib.crc32(request.node.nodeid.encode())])
