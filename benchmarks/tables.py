"""Make the tables of the documentation from the results.

    python benchmarks/tables.py speed [--write docs/speed.md]
    python benchmarks/tables.py peers [--write README.md]
    python benchmarks/tables.py batches [--write docs/where-to-run.md]

A table stands between `<!-- speed -->` and `<!-- /speed -->`, and is replaced; so for the other name.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
BASE = "saclab"
PEER_ROWS = ("Stable-Baselines3", "SBX", "Tianshou", "RLtools, MKL", "RLtools, OpenBLAS", "TorchRL")
PEERS = ("stable-baselines3", "sbx-rl", "tianshou", "rltools", "mkl", "openblas", "torchrl", "tensordict", "torch")


def speed_table(record: dict[str, Any]) -> str:
    """One row per case and contestant: medians over the rounds, ratios paired within a round."""
    machine, versions = record["machine"], record["versions"]
    lines = [
        f"{machine['processor']}, {record['cores']} cores; {record['date'][:10]}; Python {versions['python']}, jax "
        f"{versions['jax']}, mujoco {versions['mujoco']}; {peers_of(record)}. Medians of "
        f"{rounds_of(record)} alternating rounds, of ratios and shares within "
        "a round (lowest and highest in brackets).",
        "",
        "| case | | updates/s | share of the limit | saclab's rate / its | CPU s per 1000 updates | first update, s "
        "| peak, MiB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for case, entry in record["cases"].items():
        rounds = entry["rounds"]
        for name in [name for name in rounds[0] if name != "limit"]:
            lines.append("| " + " | ".join(row(case if name == BASE else "", name, rounds)) + " |")
    return "\n".join(lines)


def rounds_of(record: dict[str, Any]) -> str:
    counts = sorted({len(entry["rounds"]) for entry in record["cases"].values()})
    return " or ".join(map(str, counts))


def peers_table(record: dict[str, Any]) -> str:
    """One row for each library: its rates in two cases, and how much faster saclab is, at least and at most."""
    cases = [entry["rounds"] for entry in record["cases"].values()]
    shown = ("HalfCheetah-v4, 1:5, single run", "HalfCheetah-v4, 1:5, grid")
    lines = [
        "| HalfCheetah-v4, an update every 5 steps | single run, updates/s | grid, updates/s "
        f"| saclab's rate / its, in up to {len(cases)} cases, Humanoid-v4 and an update every step among them |",
        "|---|---|---|---|",
    ]
    raced = {name for rounds in cases for name in rounds[0]}
    for name in (BASE, *(name for name in PEER_ROWS if name in raced)):
        raced_here = [record["cases"][case]["rounds"] for case in shown]
        rates = [row("", name, rounds)[2] if name in rounds[0] else "" for rounds in raced_here]
        ratios = sorted(statistics.median(ratios_to(name, rounds)) for rounds in cases if name in rounds[0])
        faster = "" if name == BASE else f"{ratios[0]:.2f} to {ratios[-1]:.2f}×"
        lines.append(f"| {name} | {rates[0]} | {rates[1]} | {faster} |")
    return "\n".join(lines)


def ratios_to(name: str, rounds: list[dict[str, Any]]) -> list[float]:
    """The rate of saclab divided by that of `name` in the same round, for each round."""
    return [entry[BASE]["updates_per_second"] / entry[name]["updates_per_second"] for entry in rounds]


def with_spread(values: list[float], digits: int, unit: str = "") -> str:
    """The median, the lowest and the highest."""
    median, low, high = (f"{value:.{digits}f}" for value in (statistics.median(values), min(values), max(values)))
    return f"{median}{unit} ({low}–{high})"


def row(case: str, name: str, rounds: list[dict[str, Any]]) -> list[str]:
    rates = [entry[name]["updates_per_second"] for entry in rounds]
    limit = "averaged" if name.endswith("averaged") else "updates_per_second"
    shares = [entry[name]["updates_per_second"] / entry["limit"][limit] for entry in rounds]

    def median(key: str) -> float:
        return statistics.median(entry[name][key] for entry in rounds)

    return [
        case, name, with_spread(rates, 0), with_spread(shares, 2),
        "" if name == BASE else with_spread(ratios_to(name, rounds), 2, "×"),
        f"{median('cpu_seconds_per_1000_updates'):.1f}",
        f"{median('first_update_seconds'):.1f}", f"{median('peak_bytes') / 2**20:.0f}",
    ]  # fmt: skip


def peers_of(record: dict[str, Any]) -> str:
    found: dict[str, str] = {}
    for entry in record["cases"].values():
        for result in entry["rounds"][0].values():
            found |= {name: version for name, version in result.get("versions", {}).items() if name in PEERS}
    return ", ".join(f"{name} {version}" for name, version in sorted(found.items()))


def batches_tables() -> str:
    """One table per device and environment that batches.py has measured."""
    tables = []
    for path in sorted(RESULTS.glob("batches-*.json")):
        record = json.loads(path.read_text())
        machine, versions = record["machine"], record["versions"]
        tables += [
            f"{record['environment']} on {machine['device']} ({machine['processor']}, {record['cores']} cores); "
            f"{record['date'][:10]}; Python {versions['python']}, jax {versions['jax']}. In brackets: the share of a "
            "step in which the host waits for actions.",
            "",
            "| variant | runs of the group | program alone, updates/s | run group, steps/s | one run alone, steps/s "
            "| one run per core, steps/s | peak so far, MiB |",
            "|---|---|---|---|---|---|---|",
            *(batches_row(row) for row in record["rows"]),
            "",
        ]
    return "\n".join(tables).rstrip()


def batches_row(row: dict[str, Any]) -> str:
    waiting = row["shares"]["waiting for actions"]
    peak = row["device_peak_bytes"] or row["process_peak_bytes"]
    cells = [
        row["variant"], str(row["runs"]), f"{row['program_updates_per_second']:.0f}",
        f"{row['steps_per_second']:.0f} ({waiting:.2f})",
        *(f"{row[name]:.0f}" if name in row else "" for name in ("one_run", "one_run_per_core")),
        f"{peak / 2**20:.0f}",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def replace_between(text: str, name: str, table: str) -> str:
    before, start, rest = text.partition(f"<!-- {name} -->")
    _, end, after = rest.partition(f"<!-- /{name} -->")
    if not (start and end):
        raise SystemExit(f"no place for the table: <!-- {name} --> … <!-- /{name} --> is missing")
    return f"{before}{start}\n{table}\n{end}{after}"


def made(name: str, results: Path = RESULTS / "speed.json") -> str:
    """A table by its name; those of the race from its results."""
    if name == "batches":
        return batches_tables()
    record = json.loads(results.read_text())
    return speed_table(record) if name == "speed" else peers_table(record)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=("speed", "peers", "batches"))
    parser.add_argument("--write", type=Path, help="the file to put the table into; printed otherwise")
    parser.add_argument("--results", type=Path, default=RESULTS / "speed.json", help="of the race")
    options = parser.parse_args()
    table = made(options.name, options.results)
    if options.write is None:
        print(table)
        return
    options.write.write_text(replace_between(options.write.read_text(), options.name, table))


if __name__ == "__main__":
    main()
