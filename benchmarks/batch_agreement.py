"""Do the runs of a group learn as runs alone do? Compare the evaluation returns of two folders of runs.

    saclab compare HalfCheetah-v4 --variants sac-auto --seeds 8 --protocol quick --acting-delay 1 --runs alone
    saclab compare HalfCheetah-v4 --variants sac-auto --seeds 8 --protocol quick --acting-delay 1 --batch 8 --runs group
    python benchmarks/batch_agreement.py alone group --figure docs/images/batch-curves.png

Prints, for the mean over all evaluations and for the last one, the means over seeds with their standard errors, the
difference with a 95 % interval (Welch) and the probability that a run of the first folder is above one of the second.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

from saclab.training.run_folder import find_runs, read_run

COLOURS = ("#1f77b4", "#d62728")


def curves(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Steps [evaluations] and mean evaluation returns [runs, evaluations]."""
    runs = [read_run(path) for path in find_runs([folder])]
    return runs[0].evaluations["steps"], np.array([run.evaluations["mean_return"] for run in runs])


def agreement(first: np.ndarray, second: np.ndarray) -> str:
    """Compare two samples of one number per run."""
    welch = stats.ttest_ind(first, second, equal_var=False)
    low, high = welch.confidence_interval()
    above = stats.mannwhitneyu(first, second).statistic / (len(first) * len(second))
    means = [f"{part.mean():.0f} ± {part.std(ddof=1) / len(part) ** 0.5:.0f}" for part in (first, second)]
    return (
        f"{means[0]} and {means[1]}; difference {first.mean() - second.mean():.0f} [{low:.0f}, {high:.0f}], "
        f"p = {welch.pvalue:.2f}; P(first above second) = {above:.2f}"
    )


def draw(folders: list[Path], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for folder, colour in zip(folders, COLOURS, strict=True):
        steps, returns = curves(folder)
        axes.plot(steps, returns.T, color=colour, alpha=0.25, linewidth=0.8)
        axes.plot(
            steps, returns.mean(axis=0), color=colour, linewidth=2, label=f"{folder.name}, mean of {len(returns)}"
        )
    axes.set(xlabel="environment steps", ylabel="mean return of an evaluation")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs=2)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    (_, first), (_, second) = (curves(folder) for folder in options.folders)
    names = " and ".join(folder.name for folder in options.folders)
    print(f"{names}, mean over all evaluations: {agreement(first.mean(axis=1), second.mean(axis=1))}")
    print(f"{names}, last evaluation: {agreement(first[:, -1], second[:, -1])}")
    if options.figure:
        draw(options.folders, options.figure)


if __name__ == "__main__":
    main()
