"""Tianshou by its own off-policy trainer: an epoch ends with an evaluation, side by side; the best policy is saved."""

from __future__ import annotations

import logging
from pathlib import Path

import gymnasium
import torch
from stopwatch import Job, Stopwatch
from tianshou.algorithm import SAC
from tianshou.algorithm.algorithm_base import Algorithm
from tianshou.algorithm.modelfree.sac import SACPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, CollectStats, ReplayBuffer, VectorReplayBuffer
from tianshou.env import DummyVectorEnv
from tianshou.trainer import OffPolicyTrainerParams
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

gymnasium.logger.min_level = gymnasium.logger.ERROR
logging.getLogger("tianshou").setLevel(logging.WARNING)
HIDDEN_LAYERS = [256, 256]


def main() -> None:
    job = Job.from_command_line()
    stopwatch = Stopwatch(job)
    algorithm = make_algorithm(job)
    training = Collector[CollectStats](algorithm, gymnasium.make(job.environment), ReplayBuffer(job.replay_capacity))
    evaluated = DummyVectorEnv([lambda: gymnasium.make(job.environment) for _ in range(job.evaluation_episodes)])
    evaluation_buffer = VectorReplayBuffer(2 * job.evaluation_episodes, job.evaluation_episodes)
    training.reset()
    training.collect(n_step=job.random_steps, random=True)

    def watch(epoch: int, env_step: int) -> None:
        """Called before each round of collecting and updating, with the steps since the random ones."""
        stopwatch.updates_made(env_step // job.update_interval)

    def save_best(algorithm: Algorithm) -> None:
        torch.save(algorithm.policy.state_dict(), Path(job.folder).with_suffix(".pth"))

    algorithm.run_training(
        OffPolicyTrainerParams(
            training_collector=training,
            test_collector=Collector[CollectStats](algorithm, evaluated, evaluation_buffer),
            max_epochs=-(-job.steps // job.evaluation_interval_steps),
            epoch_num_steps=job.evaluation_interval_steps,
            collection_step_num_env_steps=job.update_interval,
            update_step_num_gradient_steps_per_sample=1 / job.update_interval,
            test_step_num_episodes=job.evaluation_episodes,
            batch_size=256,
            training_fn=watch,
            stop_fn=lambda _: stopwatch.end is not None,
            save_best_fn=save_best,
            show_progress=False,
            verbose=False,
        )
    )
    stopwatch.report("tianshou", "torch")


def make_algorithm(job: Job) -> SAC:
    with gymnasium.make(job.environment) as environment:
        observations, actions = environment.observation_space, environment.action_space
    actor = ContinuousActorProbabilistic(
        preprocess_net=Net(state_shape=observations.shape, hidden_sizes=HIDDEN_LAYERS),
        action_shape=actions.shape, unbounded=True, conditioned_sigma=True,
    )  # fmt: skip

    def critic() -> ContinuousCritic:
        network = Net(
            state_shape=observations.shape, action_shape=actions.shape, hidden_sizes=HIDDEN_LAYERS, concat=True
        )
        return ContinuousCritic(preprocess_net=network)

    rate = AdamOptimizerFactory(lr=3e-4)
    return SAC(
        policy=SACPolicy(actor=actor, action_space=actions), policy_optim=rate, critic=critic(), critic_optim=rate,
        critic2=critic(), critic2_optim=rate, tau=0.005, gamma=0.99, alpha=0.2,
    )  # fmt: skip


if __name__ == "__main__":
    main()
