"""TorchRL in the manner of its own sac.py: collector, tensor storage, SACLoss; evaluations side by side in one process.

As in its own settings nothing is compiled: on one core torch.compile made it slower (CPU ms per update, HalfCheetah-v4
at 1:1: 12.5 and 13.8 without, 17.2 and 16.8 with it), on two the disturbed measurements did not agree. Only what the
loss reads is stored, and steps are neither counted nor given numbers of their episodes, which is in its favour.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium
import torch
from stopwatch import Job, Stopwatch
from tensordict.nn import InteractionType, TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, GymEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate, group_optimizers

gymnasium.logger.min_level = gymnasium.logger.ERROR
warnings.filterwarnings("ignore")
LAYERS = {"num_cells": [256, 256], "activation_class": torch.nn.ReLU}
LONGEST_EPISODE = 1000
STORED = [
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
]


def main() -> None:
    job = Job.from_command_line()
    torch.manual_seed(0)
    stopwatch = Stopwatch(job)
    environment = transformed(GymEnv(job.environment))
    policy, critic = make_networks(environment)
    update = make_update(policy, critic)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(job.replay_capacity), batch_size=256)
    evaluated = SerialEnv(job.evaluation_episodes, lambda: transformed(GymEnv(job.environment)))
    collector = Collector(
        environment, policy, frames_per_batch=job.update_interval, total_frames=job.steps + job.update_interval,
        init_random_frames=job.random_steps, track_traj_ids=False,
    )  # fmt: skip
    best, steps, updates = -float("inf"), 0, 0
    for collected in collector:
        replay.extend(collected.select(*STORED).reshape(-1))
        steps += collected.numel()
        if steps > job.random_steps:
            update(replay.sample())
            updates += 1
            stopwatch.updates_made(updates)
        if steps % job.evaluation_interval_steps == 0:
            mean_return = evaluate(policy, evaluated)
            if mean_return > best:
                best = mean_return
                torch.save(policy.state_dict(), Path(job.folder).with_suffix(".pth"))
    stopwatch.report("torchrl", "tensordict", "torch")


def transformed(environment: Any) -> TransformedEnv:
    return TransformedEnv(environment, Compose(DoubleToFloat(), RewardSum()))


def make_networks(environment: TransformedEnv) -> tuple[ProbabilisticActor, ValueOperator]:
    actions = environment.action_spec_unbatched
    network = torch.nn.Sequential(
        MLP(out_features=2 * actions.shape[-1], **LAYERS),
        NormalParamExtractor(scale_mapping="biased_softplus_1.0", scale_lb=0.1),
    )
    policy = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"], spec=actions, distribution_class=TanhNormal,
        distribution_kwargs={"low": actions.space.low, "high": actions.space.high, "tanh_loc": False},
        default_interaction_type=InteractionType.RANDOM,
    )  # fmt: skip
    critic = ValueOperator(MLP(out_features=1, **LAYERS), in_keys=["action", "observation"])
    with torch.no_grad():
        critic(policy(environment.fake_tensordict()))  # makes the lazy layers
    return policy, critic


def make_update(policy: ProbabilisticActor, critic: ValueOperator) -> Any:
    loss = SACLoss(policy, critic, num_qvalue_nets=2, loss_function="l2", alpha_init=0.2, fixed_alpha=True)
    loss.make_value_estimator(gamma=0.99)
    targets = SoftUpdate(loss, tau=0.005)
    optimizer = group_optimizers(
        torch.optim.Adam(loss.actor_network_params.flatten_keys().values(), lr=3e-4),
        torch.optim.Adam(loss.qvalue_network_params.flatten_keys().values(), lr=3e-4),
    )

    def update(batch: Any) -> Any:
        losses = loss(batch)
        (losses["loss_actor"] + losses["loss_qvalue"]).sum().backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        targets.step()
        return losses.detach()

    return update


def evaluate(policy: ProbabilisticActor, environment: TransformedEnv) -> float:
    """Mean return of an episode in each environment, with the policy's mean action."""
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        episodes = environment.rollout(LONGEST_EPISODE, policy, break_when_any_done=False, break_when_all_done=True)
    return float(episodes["next", "episode_reward"][:, -1].mean())


if __name__ == "__main__":
    main()
