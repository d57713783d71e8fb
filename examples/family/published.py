"""Means and deviations over seeds of learning curves on HalfCheetah-v4 that have been published as data.

    git clone https://github.com/dojeon-ai/SimbaV2 CLONES/SimbaV2
    git clone https://github.com/danielpalenicek/xqc CLONES/xqc
    git clone https://github.com/Holiday-Robot/FlashSAC CLONES/FlashSAC
    python examples/family/published.py CLONES > examples/family/published.csv

Those of SAC, REDQ, DroQ and CrossQ are the baselines in the repository of SimbaV2.
"""

from __future__ import annotations

import csv
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from statistics import mean, stdev

MOST_STEPS = 100_000
COMMITS = {
    "SimbaV2": "14fafb27e6f78f0b65d19b8873b4433547a2193c",
    "xqc": "9a6832bb742ef01bbe9f1e06153a9338e612dae5",
    "FlashSAC": "87edc9061150ae9e962dd84e6544e27a1554b3ab",
}
CURVES = {
    "sac-auto": ("SimbaV2", "results/baseline/sac.csv"),
    "redq": ("SimbaV2", "results/baseline/redq_utd20.csv"),
    "droq": ("SimbaV2", "results/baseline/droq_utd20.csv"),
    "crossq": ("SimbaV2", "results/baseline/crossq.csv"),
    "simbav2": ("SimbaV2", "results/simbaV2_utd2.csv"),
    "xqc": ("xqc", "results/xqc.csv"),
    "flashsac": ("FlashSAC", "results/stateRL_cpusim/FlashSAC.csv"),
}


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/family/published.py CLONES > examples/family/published.csv")
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(["variant", "steps", "seeds", "mean_return", "deviation"])
    for variant, (repository, path) in CURVES.items():
        command = ["git", "-C", Path(sys.argv[1]) / repository, "show", f"{COMMITS[repository]}:{path}"]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        for steps, returns in curve(text).items():
            table.writerow([variant, steps, len(returns), f"{mean(returns):.1f}", f"{stdev(returns):.1f}"])


def curve(text: str) -> dict[int, list[float]]:
    """Environment steps -> the mean return of each seed's evaluation."""
    found: dict[int, list[float]] = defaultdict(list)
    for row in csv.DictReader(text.splitlines()):
        steps = int(float(row["env_step"]))
        if row["env_name"] == "HalfCheetah-v4" and row["metric"] == "avg_return" and 1 < steps <= MOST_STEPS:
            found[steps].append(float(row["value"]))
    return dict(sorted(found.items()))


if __name__ == "__main__":
    main()
