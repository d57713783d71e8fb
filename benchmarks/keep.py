"""Results are kept with what they depend on: date, versions, machine."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from saclab.machine import machine_facts, usable_cores

RESULTS = Path(__file__).parent / "results"


def facts(device: str = "") -> dict[str, Any]:
    """What stands before the results; `device` is what XLA computes on."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="minutes"),
        **machine_facts(device),
        "cores": len(usable_cores()),
    }


def keep(name: str, device: str = "", **results: Any) -> None:
    """Write results/<name>.json."""
    (RESULTS / f"{name}.json").write_text(json.dumps(facts(device) | results, indent=1) + "\n")
