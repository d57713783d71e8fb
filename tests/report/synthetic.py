"""Run folders without a training: made-up curves in the columns that run_folder itself defines."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from saclab.algorithm.learner import metric_names
from saclab.files import write_json
from saclab.protocols import make_config
from saclab.records import Result
from saclab.settings import AlgorithmSettings
from saclab.training.logs import EPISODE_COLUMNS, Q_BIAS_COLUMNS, evaluation_columns
from saclab.training.run_folder import FORMAT, run_path

VERSIONS = {"saclab": "0.1.0", "jax": "0.10.2", "gymnasium": "1.4.0", "mujoco": "4.0.0", "python": "3.11.9"}
METRICS = metric_names(AlgorithmSettings())


def write_run(
    root: Path,
    variant: str = "sac",
    seed: int = 0,
    environment: str = "HalfCheetah-v4",
    protocol: str = "paper",
    overrides: dict[str, Any] | None = None,
    versions: dict[str, str] | None = None,
    evaluations: int = 30,
    level: float = 8000.0,
    finished: bool = True,
    metrics: tuple[str, ...] = METRICS,
    constants: dict[str, float] | None = None,
    rename: dict[str, Any] | None = None,
    name: str | None = None,
    returns: list[float] | None = None,
    q_bias: bool = False,
    prefill: dict[str, Any] | None = None,
) -> Path:
    """Write one run and return its folder; `returns` are the evaluation returns, else a noisy rise to about `level`.

    `constants` are metrics that keep one value.
    """
    config = make_config(environment, variant, protocol, seed, overrides=overrides)
    folder = run_path(root, config, name)
    folder.mkdir(parents=True)
    content = {
        "format": FORMAT,
        "config": config.to_dict() | (rename or {}),
        "versions": VERSIONS | (versions or {}),
        "machine": {"system": "Linux", "processor": "x86_64", "threads": 1},
    }
    if prefill is not None:
        content["prefill"] = prefill
    (folder / "config.json").write_text(json.dumps(content))
    generator = np.random.default_rng([seed, len(variant)])
    count = evaluations if returns is None else len(returns)
    curve = level * (1 - np.exp(-np.arange(10 * count + 10) / (3.0 * count + 3)))
    curve = curve + generator.normal(0, 0.03 * abs(level), curve.shape) + generator.normal(0, 0.05 * abs(level))
    write_evaluations(folder, generator, curve, count, returns, config.training.evaluation_episodes)
    write_episodes(folder, curve, 10 * count)
    write_metrics(folder, generator, curve, 10 * count, metrics, constants or {})
    write_q_bias(folder, count if q_bias else 0)
    if finished:
        write_result(folder)
    return folder


def write_result(folder: Path) -> None:
    """What follows from the evaluations; its counters are made up."""
    with (folder / "evaluations.csv").open() as file:
        means = [float(row["mean_return"]) for row in csv.DictReader(file)]
    result = Result("max_updates", 1000, 200, 10, max(means), means[-1], 2.0)
    write_json(folder / "result.json", result)


def write_evaluations(
    folder: Path, generator: Any, curve: np.ndarray, count: int, returns: list[float] | None, episodes: int
) -> None:
    with (folder / "evaluations.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(evaluation_columns(episodes))
        for index in range(count):
            episode = 10 * (index + 1)
            each = curve[episode] + generator.normal(0, 100, episodes) if returns is None else returns[index]
            each = np.broadcast_to(each, episodes)
            writer.writerow([index + 1, 1000 * episode, 200 * episode, episode, each.mean(), *each,
                             *[1000] * episodes, 2.0 * episode])  # fmt: skip


def write_episodes(folder: Path, curve: np.ndarray, count: int) -> None:
    average = 0.0
    with (folder / "episodes.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(EPISODE_COLUMNS)
        for episode in range(1, count + 1):
            average = 0.8 * average + 0.2 * curve[episode]
            writer.writerow([episode, 1000 * episode, 200 * episode, curve[episode], average, 1000, 0, 2.0 * episode])


def write_q_bias(folder: Path, count: int) -> None:
    with (folder / "q_bias.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, Q_BIAS_COLUMNS, restval=1.0)
        writer.writeheader()
        for index in range(1, count + 1):
            writer.writerow({
                "evaluation": index, "steps": 10_000 * index, "updates": 2000 * index, "episodes": 10 * index,
                "mean_bias": 0.5 / index, "pairs": 100, "seconds": 20.0 * index,
            })  # fmt: skip


def write_metrics(
    folder: Path, generator: Any, curve: np.ndarray, count: int, names: tuple[str, ...], constants: dict[str, float]
) -> None:
    with (folder / "metrics.jsonl").open("w") as file:
        for window in range(1, count + 1):
            values = {name: float(generator.normal(1, 0.1)) for name in names} | constants
            if "actor_loss" in names:
                values["actor_loss"] = -curve[window] / 10
            file.write(json.dumps({"updates": 200 * window, "steps": 1000 * window, **values, "seconds": 2.0 * window}))
            file.write("\n")
