"""Record a Minari data set of the policy of a run, or of random actions: `python record.py --help`."""

from __future__ import annotations

import argparse

import gymnasium
import minari

import saclab


def main() -> None:
    line = argparse.ArgumentParser(description=__doc__)
    line.add_argument("environment", help="Gymnasium id, such as Pendulum-v1")
    line.add_argument("data_set", help="id of the data set, such as pendulum/trained-v0")
    line.add_argument("--run", help="run folder whose policy acts; random actions if there is none")
    line.add_argument("--steps", type=int, default=10_000)
    chosen = line.parse_args()
    environment = minari.DataCollector(gymnasium.make(chosen.environment))
    policy = saclab.load_policy(chosen.run) if chosen.run else None
    environment.action_space.seed(0)
    observation, _ = environment.reset(seed=0)
    for _ in range(chosen.steps):
        if policy is None:
            action = environment.action_space.sample()
        else:
            action, _ = policy.predict(observation, deterministic=False)
        observation, _, terminated, truncated, _ = environment.step(action)
        if terminated or truncated:
            observation, _ = environment.reset()
    recorded = environment.create_dataset(
        chosen.data_set,
        algorithm_name="saclab" if policy else "random actions",
        author="me",
        author_email="me@example.org",
        code_permalink="examples/prefill/record.py",
        description=f"{chosen.steps} steps of {chosen.environment}",
        eval_env=chosen.environment,
    )
    environment.close()
    print(f"{recorded.id}: {recorded.total_steps} steps in {recorded.total_episodes} episodes")


if __name__ == "__main__":
    main()
