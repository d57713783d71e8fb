"""Put the finished runs of an experiment beside its plan, as text and small enough for a repository.

    python examples/collect.py RUNS examples/averaging
    python examples/collect.py RUNS examples/curriculum

Copies what a report needs of each run to the folder `runs` of the second: config.json, result.json and the logs, of
the longest some lines only, numbers rounded to five significant digits. `saclab report examples/averaging/runs` makes
the page again from them.
"""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path

EVERY = {"metrics.jsonl": 10, "episodes.csv": 5, "evaluations.csv": 1, "q_bias.csv": 1, "reward_terms.csv": 1}
"""Of each log that a run has, the lines that are kept."""


def main() -> None:
    if len(sys.argv) != 3:
        sys.exit("usage: python examples/collect.py RUNS EXAMPLE")
    root, kept, collected = Path(sys.argv[1]), Path(sys.argv[2]) / "runs", 0
    for result in sorted(root.rglob("result.json")):
        run = result.parent
        copy = kept / run.relative_to(root)
        copy.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(run / "config.json", copy / "config.json")
        told = json.loads(result.read_text())
        told.pop("files", None)  # the checksums of logs with all their lines
        (copy / "result.json").write_text(json.dumps(told, indent=2) + "\n")
        for name, every in EVERY.items():
            if (run / name).exists():
                thin = thin_json_lines if name.endswith(".jsonl") else thin_csv
                (copy / name).write_text(thin((run / name).read_text(), every))
        collected += 1
    size = sum(path.stat().st_size for path in kept.rglob("*") if path.is_file())
    print(f"{collected} finished runs collected, {size / 1e6:.1f} MB")


def thin_json_lines(text: str, every: int) -> str:
    lines = [json.loads(line) for line in text.splitlines()[every - 1 :: every]]
    return "".join(json.dumps({name: rounded(value) for name, value in line.items()}) + "\n" for line in lines)


def thin_csv(text: str, every: int) -> str:
    header, *rows = csv.reader(text.splitlines())
    kept = [header, *([str(rounded(float(value))) for value in row] for row in rows[every - 1 :: every])]
    return "".join(",".join(row) + "\n" for row in kept)


def rounded(value: float) -> float | int:
    """Whole numbers as they are, others to five significant digits."""
    short = value if value % 1 == 0 else float(f"{value:.5g}")
    return int(short) if short % 1 == 0 else short


if __name__ == "__main__":
    main()
