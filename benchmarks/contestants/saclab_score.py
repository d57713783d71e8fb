"""saclab as its own commands train, until an evaluation reaches a score."""

from __future__ import annotations

from pathlib import Path

from score_watch import ScoreJob, ScoreWatch

from saclab.protocols import make_config
from saclab.training.events import Evaluated
from saclab.training.loop import train


def main() -> None:
    job = ScoreJob.from_command_line()
    watch, settings = ScoreWatch(job), dict(job.settings)
    variant, protocol = str(settings.pop("variant")), str(settings.pop("protocol"))
    settings |= {
        "evaluation_interval_steps": job.evaluation_interval_steps,
        "evaluation_episodes": job.evaluation_episodes,
    }
    config = make_config(job.environment, variant, protocol, job.seed, overrides=settings)
    for event in train(config, Path(job.folder) / "run"):
        if not isinstance(event, Evaluated):
            continue
        if watch.evaluated(event.steps, float(event.total_rewards.mean())) or event.steps >= job.most_steps:
            break  # the protocol's own end stays, and with it the schedules of learning rates
    watch.report()


if __name__ == "__main__":
    main()
