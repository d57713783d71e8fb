"""How long the fuzzers look: `fast` finds the same each time, `slow` and `long` (make fuzz) look further.

What has failed once stays as an `@example` beside its test.
"""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

CHECKS = (HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large)
settings.register_profile(
    "fast", max_examples=50, derandomize=True, database=None, deadline=None, suppress_health_check=CHECKS
)
settings.register_profile("slow", parent=settings.get_profile("fast"), max_examples=2000)
settings.register_profile(
    "long", parent=settings.get_profile("fast"), max_examples=20_000, derandomize=False, print_blob=True
)
ASKED = os.environ.get("SACLAB_FUZZ", "")
settings.load_profile(ASKED or "fast")
FAST = settings.get_profile("fast")
SLOW = settings.get_profile(ASKED or "slow")
