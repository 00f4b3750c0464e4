"""What all tests share: the hypothesis profile, the way to the helpers, the command line."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

if "PYTEST_XDIST_WORKER" in os.environ:
    # One process per core: more threads in each would only wait for one another.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Tests are imported by path (``--import-mode=importlib``), their helpers and benchmarks by name.
sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(1, str(Path(__file__).parent / "benchmarks"))

from command import Call, Ended
from small_scene import write_photographs

from colmap_affrect.cli import main
from colmap_affrect.errors import AffrectError, with_flags

# So that pytest says what a check of a contract has found, as it does of tests.
pytest.register_assert_rewrite("contracts.contracts", "contracts.mapper_contract")

settings.register_profile(
    "ci",
    derandomize=True,
    deadline=None,
    max_examples=25,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(
    "nightly", parent=settings.get_profile("ci"), max_examples=1000
)
settings.load_profile("ci")


os.fsync = lambda _: None  # no test can tell whether a disk has been waited for


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The four photographs of the small scene; nothing may be changed there."""
    folder = tmp_path_factory.mktemp("photos č")
    write_photographs(folder)
    return folder


@pytest.fixture(autouse=True)
def _flags_in_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have errors of functions name flags as those of commands; tests of functions turn it off."""
    monkeypatch.setattr(AffrectError, "__str__", lambda error: with_flags(error.words))


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str]) -> Call:
    """Run the command line here."""

    def run_command(*arguments: object) -> Ended:
        capfd.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:  # argparse: help, or wrong usage
            code = end.code
        captured = capfd.readouterr()
        return Ended(code, captured.out, captured.err.splitlines())

    return run_command
