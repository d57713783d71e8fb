"""Train, evaluate, record and report in loops, and see that nothing grows: descriptors, threads, processes, memory.

    NPROC=1 python benchmarks/soak.py [minutes]

30 minutes unless others are given. A round trains a run alone and a run group, evaluates, films and reports in this one
process, and does the same by the command line. What is open after each round is counted. The first third of the rounds
warms up: what is compiled and cached once is taken then. After it, open descriptors, threads and child processes must
be as many in the last round as in the first, and two measures of memory must not grow, by a straight line through the
rounds (Theil and Sen's: the median of the slopes between any two): what malloc has given out by more than
`GROWTH_BYTES` a round, and what is resident by more than `RESIDENT_BYTES`. That one moves in steps: malloc takes some
megabytes more, now and then, where what is free lies in pieces. Exit status 1 if one does.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from ctypes.util import find_library
from itertools import combinations
from pathlib import Path
from typing import ClassVar, NamedTuple

import saclab
from saclab.batch.loop import train_batch
from saclab.playback import evaluate, record
from saclab.protocols import make_config
from saclab.report.report import write_report
from saclab.training.run_folder import find_runs

GROWTH_BYTES = 256 * 1024
"""A round's replay buffers, learners and figures take some 100 MB: what is lost of them would be seen."""
RESIDENT_BYTES = 3 * 2**20
RESIDENT_ROUNDS = 12
"""It is judged from so many rounds after the warm-up on: over fewer, one step of it is a slope."""
LEAST_ROUNDS = 6
SETTINGS = {
    "hidden_layers": (32, 32), "batch_size": 32, "random_steps": 100, "max_steps": 600, "replay_capacity": 20_000,
    "evaluation_interval_steps": 200, "evaluation_episodes": 2, "q_bias_episodes": 1,
}  # fmt: skip


class Sample(NamedTuple):
    """What is open after a round."""

    descriptors: int
    threads: int
    children: int
    resident_bytes: int
    allocated_bytes: int


class Allocated(ctypes.Structure):
    """What glibc's mallinfo2 tells."""

    _fields_: ClassVar = [(name, ctypes.c_size_t) for name in (
        "arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost",
    )]  # fmt: skip


def allocated_bytes() -> int:
    """What malloc has given out and not taken back; 0 where the C library is not glibc."""
    mallinfo = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if mallinfo is None:
        return 0
    mallinfo.restype = Allocated
    told = mallinfo()
    return int(told.uordblks + told.hblkhd)


def sample() -> Sample:
    """Of this process now, from Linux's /proc."""
    gc.collect()
    tasks = list(Path("/proc/self/task").iterdir())
    children = sum(len((task / "children").read_text().split()) for task in tasks)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Sample(
        len(list(Path("/proc/self/fd").iterdir())),
        len(tasks),
        children,
        pages * os.sysconf("SC_PAGE_SIZE"),
        allocated_bytes(),
    )


def one_round(folder: Path, number: int, commands: bool) -> None:
    """Everything once."""
    run = saclab.train("HalfCheetah-v4", "averaged", number, "quick", runs=folder / "runs", **SETTINGS)
    configs = [make_config("Pendulum-v1", "sac", "quick", seed, None, SETTINGS) for seed in (0, 1)]
    list(train_batch(configs, [folder / f"group/{seed}" for seed in (0, 1)], workers=2))
    evaluate(run.path, episodes=3, seed=number)
    if find_library("EGL"):
        record(run.path, folder / "film.mp4", steps=10, seed=number, size=64)
    write_report(find_runs([folder]), folder / "report", allow_mixed=True)
    if commands:
        words = [word for name, value in SETTINGS.items() for word in option(name, value)]
        for command in (
            ["train", "Pendulum-v1", "--protocol", "quick", "--runs", str(folder / "told"), *words],
            ["evaluate", str(folder / "told/Pendulum-v1/sac-auto/quick/seed-0"), "--episodes", "2"],
            ["report", str(folder / "told"), "--out", str(folder / "told-report")],
        ):
            subprocess.run([sys.executable, "-m", "saclab", *command], check=True, stdout=subprocess.DEVNULL)


def option(name: str, value: object) -> list[str]:
    """A setting as it stands on the command line."""
    return ["--" + name.replace("_", "-"), *map(str, value if isinstance(value, tuple) else [value])]


def slope(values: Sequence[float]) -> float:
    """The median of the slopes between any two of the values, which are one round apart."""
    return statistics.median((b - a) / (j - i) for (i, a), (j, b) in combinations(enumerate(values), 2))


def soak(seconds: float, commands_every: int = 4) -> list[Sample]:
    """Rounds for so long, and a sample after each; every so many rounds do the same by the command line."""
    samples: list[Sample] = []
    deadline = time.monotonic() + seconds
    while len(samples) < LEAST_ROUNDS or time.monotonic() < deadline:
        folder = Path(tempfile.mkdtemp())
        try:
            one_round(folder, len(samples), commands=len(samples) % commands_every == 0)
        finally:
            shutil.rmtree(folder)
        samples.append(sample())
        print(json.dumps(samples[-1]._asdict()), flush=True)
    return samples


def grown(samples: Sequence[Sample]) -> dict[str, float]:
    """What has grown after the warm-up: how many more of each, and bytes of memory a round."""
    kept = samples[len(samples) // 3 :]
    found = {name: getattr(kept[-1], name) - getattr(kept[0], name) for name in ("descriptors", "threads", "children")}
    leaks: dict[str, float] = {name: more for name, more in found.items() if more > 0}
    for name, bound in (("allocated_bytes", GROWTH_BYTES), ("resident_bytes", RESIDENT_BYTES)):
        if name == "resident_bytes" and len(kept) < RESIDENT_ROUNDS:
            continue
        if (each_round := slope([getattr(each, name) for each in kept])) > bound:
            leaks[name] = each_round
    return leaks


def main() -> int:
    samples = soak(60 * float(sys.argv[1] if len(sys.argv) > 1 else 30))
    kept = samples[len(samples) // 3 :]
    for name in ("allocated_bytes", "resident_bytes"):
        values = [getattr(each, name) for each in kept]
        print(f"{len(samples)} rounds; {name} {values[-1] / 2**20:.0f} MiB, {slope(values) / 1024:+.0f} KiB a round")
    print(f"grown: {leaks}" if (leaks := grown(samples)) else "nothing has grown")
    return 1 if leaks else 0


if __name__ == "__main__":
    sys.exit(main())
