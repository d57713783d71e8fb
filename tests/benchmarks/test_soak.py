"""That nothing grows while trainings, evaluations, films and reports follow each other in one process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import soak
from soak import GROWTH_BYTES, Sample, grown, sample, slope

LEVEL = [Sample(10, 17, 0, 2**29, 2**28)] * 9


def test_what_grows_after_the_warm_up_is_named():
    assert grown(LEVEL) == {}
    assert grown([Sample(4, 3, 0, 2**20, 2**19), *LEVEL[1:]]) == {}, "the first third warms up"
    assert grown([*LEVEL[1:], Sample(12, 17, 1, 2**29, 2**28)]) == {"descriptors": 2, "children": 1}
    lost = [each._replace(allocated_bytes=2**28 + number * 2 * GROWTH_BYTES) for number, each in enumerate(LEVEL)]
    assert grown(lost) == {"allocated_bytes": 2 * GROWTH_BYTES}
    swollen = [each._replace(resident_bytes=2**29 + number * 2**22) for number, each in enumerate(LEVEL * 3)]
    assert grown(swollen) == {"resident_bytes": 2**22}
    assert grown(swollen[:9]) == {}, "too few rounds to tell a slope from a step"


def test_one_outlier_makes_no_slope():
    assert slope([5.0, 5.0, 900.0, 5.0, 5.0]) == 0
    assert slope([1.0, 2.0, 3.0]) == 1


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="this system has no /proc")
def test_what_is_open_is_counted():
    before = sample()
    ends = os.pipe()
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=ends[0])
    after = sample()
    for end in ends:
        os.close(end)
    child.wait()
    assert (after.descriptors - before.descriptors, after.children - before.children) == (2, 1)


@pytest.mark.slow
def test_nothing_grows_in_a_minute():
    """The measurement itself runs for half an hour."""
    done = subprocess.run([sys.executable, soak.__file__, "1"], capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == "nothing has grown"
