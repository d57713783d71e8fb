"""What run groups cost on this machine's devices, and what they gain.

    python benchmarks/batches.py [HalfCheetah-v4] [--runs 1 4 16 64] [--seconds 10] [--alone]

Kept in benchmarks/results/batches-<device>-<environment>.json: updates per second, summed over the runs of a group, of
the compiled program alone (plain and averaged, K = 10); environment steps per second of whole groups at one update per
step, with the share of each part of a step; and with --alone the same job by one run alone on all cores, and by as many
processes as cores, one run each, in turn with the groups. Compilation and the random steps are outside all rates.
Evaluations and logs are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import jax
import numpy as np
from keep import keep

from saclab.batch.builder import DeviceBuilder
from saclab.batch.engine import DeviceEngine
from saclab.config import Config
from saclab.machine import thread_limits, usable_cores
from saclab.protocols import make_config
from saclab.training.engine import build_new
from saclab.training.local_engine import LocalEngine
from saclab.training.process import device_name, prepare_process

RANDOM_STEPS = 300
ROUNDS = 5
PARTS = ("_launch", "_take_experience", "pool.step")


def config(environment: str, variant: str, seed: int) -> Config:
    overrides = {"random_steps": RANDOM_STEPS, "acting_delay": 1, "replay_capacity": 200_000, "update_interval": 1}
    return make_config(environment, variant, "standard", seed, None, overrides)


def begun(environment: str, variant: str, runs: int) -> DeviceEngine:
    """A run group after its random steps and its first updates."""
    configs = [config(environment, variant, seed) for seed in range(runs)]
    engine = build_new(DeviceBuilder(configs, 0, len(usable_cores())))
    while engine.updates < 20:
        engine.step()
    engine.actor(0)
    return engine


def rate(count: Callable[[], int], step: Callable[[], object], wait: Callable[[], object], seconds: float) -> float:
    """Median over rounds of what `count` gains per second."""
    rates = []
    for _ in range(ROUNDS):
        first, began = count(), time.perf_counter()
        while time.perf_counter() - began < seconds / ROUNDS:
            step()
        wait()
        rates.append((count() - first) / (time.perf_counter() - began))
    return statistics.median(rates)


def program_alone(engine: DeviceEngine, seconds: float) -> float:
    """Updates per second, summed over the runs, without environments."""
    runs, made = len(engine.runs), 0
    drawn = np.random.default_rng(0).integers(0, RANDOM_STEPS, (runs, 1, engine.batch_size), np.int32)
    packed = engine.program.put(engine.program.inputs(1).pack(engine.program.slots, drawn=drawn))

    def update() -> None:
        nonlocal made
        engine._advance(1, packed)
        made += runs
        if made % (20 * runs) == 0:  # no further ahead of the device than a training would be
            engine.state.key.block_until_ready()

    value = rate(lambda: made, update, lambda: engine.state.key.block_until_ready(), seconds)
    engine.undelivered = []
    return value


def whole_group(engine: DeviceEngine, seconds: float) -> tuple[float, dict[str, float]]:
    """Environment steps per second, summed, and the share of a step that each part takes of the host's time."""
    spent = dict.fromkeys(PARTS, 0.0)
    waited = 0.0
    for name in PARTS:
        owner = engine.pool if name == "pool.step" else engine
        clock(owner, name.removeprefix("pool."), spent, name)
    real = engine._next_actions

    def next_actions() -> np.ndarray:
        nonlocal waited
        began = time.perf_counter()
        actions = real()
        waited += time.perf_counter() - began
        engine.undelivered = []  # as a line of the log does
        return actions

    engine._next_actions = next_actions  # type: ignore[method-assign]
    runs, began = len(engine.runs), time.perf_counter()
    value = rate(lambda: runs * engine.steps, engine.step, lambda: engine.state.key.block_until_ready(), seconds)
    whole = time.perf_counter() - began
    shares = {name: round(part / whole, 3) for name, part in spent.items()}
    return value, {**shares, "waiting for actions": round((waited - spent["_launch"]) / whole, 3)}


def clock(owner: Any, name: str, spent: dict[str, float], entry: str) -> None:
    real = getattr(owner, name)

    def timed(*arguments: Any) -> Any:
        began = time.perf_counter()
        result = real(*arguments)
        spent[entry] += time.perf_counter() - began
        return result

    setattr(owner, name, timed)


def alone(environment: str, variant: str, seconds: float, places: list[list[int]]) -> float:
    """Environment steps per second of a process on each of these groups of cores, each with a run alone, summed."""
    processes = [
        subprocess.Popen(
            [sys.executable, __file__, environment, "--one", variant, *map(str, cores), "--seconds", str(seconds)],
            stdout=subprocess.PIPE, env=os.environ | thread_limits(len(cores)) | {"JAX_PLATFORMS": "cpu"},
        )
        for cores in places
    ]  # fmt: skip
    return sum(float(process.communicate()[0]) for process in processes)


def one_alone(environment: str, variant: str, seconds: float) -> float:
    with closing(LocalEngine.new(config(environment, variant, 0))) as engine:
        run = engine.run
        while run.counters.updates < 20:
            engine.step()

        def step() -> None:
            engine.step()
            run.window = []

        return rate(lambda: run.counters.steps, step, lambda: engine.learner_state.key.block_until_ready(), seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", nargs="?", default="HalfCheetah-v4")
    parser.add_argument("--runs", type=int, nargs="+", default=[1, 4, 16, 64])
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--one", nargs="+", metavar=("VARIANT", "CORE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        os.sched_setaffinity(0, map(int, options.one[1:]))  # before JAX starts its threads, which inherit it
    prepare_process()
    if options.one:
        print(one_alone(options.environment, options.one[0], options.seconds))
        return
    name = device_name()
    rows = []
    print(f"{options.environment} on {name}, {len(usable_cores())} cores")
    for variant in ("sac", "averaged"):
        for runs in options.runs:
            row = measure(options, variant, runs)
            rows.append(row)
            print(json.dumps(row), flush=True)
    keep(
        f"batches-{name.replace(' ', '-').lower()}-{options.environment}", name,
        command=sys.argv[1:], environment=options.environment, rows=rows,
    )  # fmt: skip


def measure(options: argparse.Namespace, variant: str, runs: int) -> dict[str, Any]:
    row: dict[str, Any] = {"variant": variant, "runs": runs}
    with closing(begun(options.environment, variant, runs)) as engine:
        steps, row["shares"] = whole_group(engine, options.seconds)
        row["steps_per_second"] = round(steps, 1)
        row["program_updates_per_second"] = round(program_alone(engine, options.seconds), 1)
        stats = jax.devices()[0].memory_stats() or {}
        row["device_peak_bytes"] = stats.get("peak_bytes_in_use")
    if options.alone:
        cores = usable_cores()
        for name, places in (("one_run", [cores]), ("one_run_per_core", [[core] for core in cores])):
            row[name] = round(alone(options.environment, variant, options.seconds, places), 1)
    row["process_peak_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return row


if __name__ == "__main__":
    main()
