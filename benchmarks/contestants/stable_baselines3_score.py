"""Stable-Baselines3's SAC at its defaults, until an evaluation reaches a score."""

from __future__ import annotations

import gymnasium
import numpy as np
from score_watch import ScoreJob, ScoreWatch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

gymnasium.logger.min_level = gymnasium.logger.ERROR


class UntilScore(EvalCallback):
    """Its own evaluations, and a stop when one reaches the score."""

    def __init__(self, watch: ScoreWatch, job: ScoreJob) -> None:
        environments = make_vec_env(job.environment, n_envs=job.evaluation_episodes)
        super().__init__(
            environments, n_eval_episodes=job.evaluation_episodes, eval_freq=job.evaluation_interval_steps,
            log_path=job.folder, best_model_save_path=job.folder, verbose=0,
        )  # fmt: skip
        self.watch = watch

    def _on_step(self) -> bool:
        goes_on = super()._on_step()
        if self.n_calls % self.eval_freq:
            return goes_on
        return goes_on and not self.watch.evaluated(self.num_timesteps, float(np.mean(self.last_mean_reward)))


def main() -> None:
    job = ScoreJob.from_command_line()
    watch = ScoreWatch(job)
    SAC("MlpPolicy", job.environment, seed=job.seed).learn(job.most_steps, callback=UntilScore(watch, job))
    watch.report()


if __name__ == "__main__":
    main()
