"""saclab through the generator that its own commands use: logs, evaluations and best policy are written as always."""

from __future__ import annotations

from pathlib import Path

from stopwatch import Job, Stopwatch

from saclab.protocols import make_config
from saclab.training.events import Progress, UpdatesLogged
from saclab.training.loop import train
from saclab.training.run_folder import read_run


def main() -> None:
    job = Job.from_command_line()
    stopwatch = Stopwatch(job)
    settings = {
        "random_steps": job.random_steps,
        "update_interval": job.update_interval,
        "replay_capacity": job.replay_capacity,
        "max_steps": job.steps,
        "evaluation_interval_steps": job.evaluation_interval_steps,
        "evaluation_episodes": job.evaluation_episodes,
        "log_interval": job.warm_updates,
    }
    variant = "sac"
    for name, value in job.settings:
        if name == "variant":
            variant = str(value)
        else:
            settings[name] = value
    config = make_config(job.environment, variant, "standard", overrides=settings)
    folder = Path(job.folder) / "run"
    for event in train(config, folder):
        match event:
            case Progress(updates=updates) if updates:
                stopwatch.updates_made(1)  # told every 0.25 s: when the first was made, no matter how many since
            case UpdatesLogged(updates=updates):
                stopwatch.updates_made(updates)
    stopwatch.report(
        "saclab", "jax", test_steps_per_step=evaluation_steps(folder, job) / job.timed_updates / job.update_interval
    )


def evaluation_steps(folder: Path, job: Job) -> float:
    """Environment steps of the evaluations that fell into the window."""
    evaluations = read_run(folder).evaluations
    since = evaluations["updates"] - job.warm_updates
    return float(evaluations["lengths"][(since >= 0) & (since < job.timed_updates)].sum())


if __name__ == "__main__":
    main()
