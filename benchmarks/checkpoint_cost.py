"""What a checkpoint of a run with a full replay buffer costs: bytes, seconds, and the share that is written anew.

    python benchmarks/checkpoint_cost.py [--folder DIR] [--rows 200000] [--new-rows 20000]

The buffer is filled with random numbers (nothing on the way compresses), the learner has the standard protocol's size.
"First" writes everything; so does the second, as the two kept checkpoints share no file; "later" is one that comes
`--new-rows` transitions after another, when both kept ones are there: the rows of two intervals are written.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from saclab.protocols import make_config
from saclab.training.checkpoint import save_checkpoint
from saclab.training.common_checkpoint import load_newest_checkpoint
from saclab.training.local_engine import LocalEngine
from saclab.training.snapshot import to_checkpoint

MIB = 2**20


def fill(engine: LocalEngine, count: int, generator: np.random.Generator) -> None:
    """Let `count` transitions of random numbers pass through the buffer."""
    replay = engine.replay
    positions = np.arange(replay.added, replay.added + count) % replay.capacity
    replay.rows[positions] = generator.standard_normal((count, replay.layout.width), np.float32)
    replay.added += count
    engine.run.counters.steps += count


def save(engine: LocalEngine, folder: Path) -> tuple[float, int, int]:
    """Seconds, bytes of the checkpoint, and those of them that were written and not linked."""
    began = time.perf_counter()
    content = to_checkpoint(engine.snapshot(0), engine.capture_environments(0))
    path = save_checkpoint(folder, engine.run.moment(), content, engine.replay)
    seconds = time.perf_counter() - began
    return seconds, size(path), written[0]


def size(path: Path) -> int:
    return sum(file.stat().st_size for file in path.iterdir())


written = [0]


def count_written() -> None:
    """Count the bytes that pass through the one function that writes."""
    from saclab.training import checkpoint

    real = checkpoint.write_bytes

    def write_bytes(path: Path, content: bytes) -> None:
        written[0] += len(content)
        real(path, content)

    checkpoint.write_bytes = write_bytes


def measure(environment: str, folder: Path, rows: int, new_rows: int) -> None:
    engine = LocalEngine.new(make_config(environment, "averaged-auto", overrides={"replay_capacity": rows}))
    generator = np.random.default_rng(0)
    fill(engine, rows, generator)
    print(f"{environment}, {rows:,} transitions of {engine.replay.layout.width} numbers, {new_rows:,} between saves")
    for name in ("first", "second", "later", "later", "later"):
        written[0] = 0
        seconds, total, new = save(engine, folder)
        print(f"  {name:<7} {total / MIB:7.1f} MiB, {new / MIB:7.1f} written ({new / total:4.0%}), {seconds:6.2f} s")
        fill(engine, new_rows, generator)
    began = time.perf_counter()
    assert load_newest_checkpoint(folder, engine.replay, print) is not None
    print(f"  load    {total / MIB:7.1f} MiB, checked against its checksums, {time.perf_counter() - began:6.2f} s")
    engine.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="on the disk to measure; default: the system's temporary folder")
    parser.add_argument("--rows", type=int, default=200_000)
    parser.add_argument("--new-rows", type=int, default=20_000)
    options = parser.parse_args()
    count_written()
    for environment in ("HalfCheetah-v4", "Humanoid-v4"):
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            measure(environment, Path(folder) / "checkpoints", options.rows, options.new_rows)


if __name__ == "__main__":
    main()
