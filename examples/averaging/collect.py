"""Put the finished runs of docs/averaging.md into this repository, as text and small enough for it.

    python examples/averaging/collect.py RUNS

Copies what a report needs of each run to examples/averaging/runs: config.json, result.json, evaluations.csv and
q_bias.csv, every tenth line of metrics.jsonl and every fifth of episodes.csv, numbers rounded to five significant
digits. `saclab report examples/averaging/runs` makes the page again from them.
"""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
EVERY = {"metrics.jsonl": 10, "episodes.csv": 5, "evaluations.csv": 1, "q_bias.csv": 1}
"""Of each log, the lines that are kept."""


def main() -> None:
    root, collected = Path(sys.argv[1]), 0
    for result in sorted(root.rglob("result.json")):
        run = result.parent
        copy = HERE / "runs" / run.relative_to(root)
        copy.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(run / "config.json", copy / "config.json")
        told = json.loads(result.read_text())
        told.pop("files", None)  # the checksums of logs with all their lines
        (copy / "result.json").write_text(json.dumps(told, indent=2) + "\n")
        for name, every in EVERY.items():
            thin = thin_json_lines if name.endswith(".jsonl") else thin_csv
            (copy / name).write_text(thin((run / name).read_text(), every))
        collected += 1
    size = sum(path.stat().st_size for path in (HERE / "runs").rglob("*") if path.is_file())
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
    return int(value) if value % 1 == 0 else float(f"{value:.5g}")


if __name__ == "__main__":
    main()
