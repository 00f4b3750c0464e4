"""Settings shared by all tests: the hypothesis profile, and the way to the helpers."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from hypothesis import HealthCheck, settings

if "PYTEST_XDIST_WORKER" in os.environ:
    # One process per core: more threads in each would only wait for one another.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Tests are imported by path (``--import-mode=importlib``), their helpers by name.
sys.path.insert(0, str(Path(__file__).parent))

settings.register_profile(
    "ci",
    derandomize=True,
    deadline=None,
    max_examples=25,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("nightly", parent=settings.get_profile("ci"), max_examples=1000)
settings.load_profile("ci")
