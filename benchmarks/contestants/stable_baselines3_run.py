"""Stable-Baselines3, and SBX, which has the same interface: `learn`, its own EvalCallback, evaluations side by side."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stopwatch import Job, Stopwatch

gymnasium.logger.min_level = gymnasium.logger.ERROR


class Watch(BaseCallback):
    def __init__(self, stopwatch: Stopwatch) -> None:
        super().__init__()
        self.stopwatch = stopwatch

    def _on_step(self) -> bool:
        self.stopwatch.updates_made(self.model._n_updates)
        return True


def main(library: str) -> None:
    job = Job.from_command_line()
    sac: Any
    if library == "sbx-rl":
        from sbx import SAC as sac  # noqa: N811
    else:
        from stable_baselines3 import SAC as sac  # noqa: N811
    stopwatch = Stopwatch(job)
    model = sac(
        "MlpPolicy", job.environment, learning_rate=3e-4, buffer_size=job.replay_capacity, batch_size=256,
        learning_starts=job.random_steps, train_freq=job.update_interval, gradient_steps=1, gamma=0.99, tau=0.005,
        ent_coef=0.2, policy_kwargs={"net_arch": [256, 256]}, seed=0,
    )  # fmt: skip
    evaluation = EvalCallback(
        make_vec_env(job.environment, n_envs=job.evaluation_episodes), n_eval_episodes=job.evaluation_episodes,
        eval_freq=job.evaluation_interval_steps, best_model_save_path=job.folder, log_path=job.folder, verbose=0,
    )  # fmt: skip
    model.learn(job.steps + job.update_interval, callback=CallbackList([Watch(stopwatch), evaluation]))
    stopwatch.report(library, "torch" if library == "stable-baselines3" else "jax")


if __name__ == "__main__":
    main(sys.argv[2])
