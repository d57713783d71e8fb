"""RLtools, compiled for the job with MKL or the system's OpenBLAS: its own loop, evaluations by its compiled policy.

It writes no logs and no policy's file here, which is in its favour.
"""

from __future__ import annotations

import ctypes
import os
import sys
from importlib.metadata import version
from typing import Any

os.environ["RL_TOOLS_FORCE_MKL" if sys.argv[2] == "mkl" else "RL_TOOLS_DISABLE_MKL"] = "1"

import gymnasium
import rltools
from gymnasium.wrappers import RescaleAction
from stopwatch import Job, Stopwatch

gymnasium.logger.min_level = gymnasium.logger.ERROR
BLAS = sys.argv[2]  # mkl or openblas; without either it is many times slower
EPISODE_STEPS = 1000


def main() -> None:
    job = Job.from_command_line()
    os.environ.setdefault("MKL_NUM_THREADS", str(len(os.sched_getaffinity(0))))
    stopwatch = Stopwatch(job)

    def environment() -> Any:
        made = RescaleAction(gymnasium.make(job.environment), -1.0, 1.0)
        made.reset(seed=0)
        return made

    cores = "_".join(map(str, sorted(os.sched_getaffinity(0))))  # processes of a grid compile at the same time
    name = f"{job.environment.lower().replace('-', '_')}_{job.update_interval}_{cores}"
    compiled = rltools.SAC(
        environment, interface_name=f"race_{BLAS}_{name}", enable_evaluation=False, GAMMA=0.99,
        ACTOR_BATCH_SIZE=256, CRITIC_BATCH_SIZE=256, CRITIC_TRAINING_INTERVAL=job.update_interval,
        ACTOR_TRAINING_INTERVAL=job.update_interval, CRITIC_TARGET_UPDATE_INTERVAL=job.update_interval,
        N_WARMUP_STEPS=job.random_steps, STEP_LIMIT=10_000_000, REPLAY_BUFFER_CAP=job.replay_capacity,
        EPISODE_STEP_LIMIT=EPISODE_STEPS, ACTOR_HIDDEN_DIM=256, ACTOR_NUM_LAYERS=3, CRITIC_HIDDEN_DIM=256,
        CRITIC_NUM_LAYERS=3, ADAPTIVE_ALPHA=False, ALPHA=0.2, OPTIMIZER_ALPHA=3e-4,
    )  # fmt: skip
    state = compiled.State(0)
    evaluated = [environment() for _ in range(job.evaluation_episodes)]
    for step in range(1, job.steps + job.update_interval + 1):
        state.step()
        stopwatch.updates_made(max(0, step - job.random_steps) // job.update_interval)
        if step % job.evaluation_interval_steps == 0:
            evaluate(state, evaluated)
    stopwatch.report("rltools", libraries={BLAS: blas_version()})


def blas_version() -> str:
    """The number, and of OpenBLAS the processor that it takes this one for."""
    if BLAS == "mkl":
        return version("mkl")
    config = ctypes.CDLL("libblas.so").openblas_get_config
    config.restype = ctypes.c_char_p
    _, number, *_, processor, _ = config().decode().split()
    return f"{number} {processor}"


def evaluate(state: Any, environments: list[Any]) -> float:
    """Mean return of an episode in each environment, with the policy's mean action."""
    total = 0.0
    for environment in environments:
        (observation, _), over = environment.reset(), False
        while not over:
            action = state.action(observation.astype("float32"))
            observation, reward, terminated, truncated, _ = environment.step(action)
            total += float(reward)
            over = terminated or truncated
    return total / len(environments)


if __name__ == "__main__":
    main()
