"""What could make the same configuration give other bits: versions and machine, recorded and compared at resume."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from collections.abc import Mapping
from importlib.metadata import entry_points, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

PACKAGES = ("saclab", "jax", "jaxlib", "numpy", "optax", "gymnasium", "mujoco")
SIMULATION_PACKAGES = ("gymnasium", "mujoco")
"""Runs whose major versions of these differ are not comparable."""
COMPILER_OPTIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""What XLA is told for each program on a CPU: no fusions by YNNPACK, which jaxlib 0.10.2 and later can compile into
wrong products or crashes (github.com/jax-ml/jax, issues 39103, 39257)."""
HOW_TO_MATCH = {
    "threads": "continue exactly with --threads {0} (or NPROC={0} in the environment)",
    "numpy_threads": "continue exactly with OPENBLAS_NUM_THREADS={0} in the environment (--threads sets it too)",
    "xla_flags": "continue exactly with XLA_FLAGS={0!r} in the environment",
    "batch": "continue exactly in a run group of {0} (0: alone; see --batch)",
}


def machine_facts(device: str = "", batch: int = 0) -> dict[str, Any]:
    """The versions and the machine of this process.

    Args:
        device: what XLA computes on; empty where nothing is computed.
        batch: slots of the run group that a run is trained in; 0 if it is alone.
    """
    options = COMPILER_OPTIONS if device == "cpu" else {}
    return {
        "versions": {package: version(package) for package in PACKAGES} | {"python": platform.python_version()},
        "machine": {
            "system": " ".join((platform.system(), platform.machine(), *platform.libc_ver())).strip(),
            "processor": processor_name(),
            "threads": visible_threads("NPROC"),
            "numpy_threads": visible_threads("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"),
            "xla_flags": os.environ.get("XLA_FLAGS", ""),
            "compiler_options": " ".join(f"{name}={value}" for name, value in options.items()),
            "device": device,
            "batch": batch,
        },
    }


def visible_threads(*variables: str) -> int:
    """Threads that XLA (NPROC) or NumPy uses on the CPU: the results depend on their number."""
    for variable in variables:
        if (value := os.environ.get(variable, "")).isdecimal() and int(value) > 0:
            return int(value)
    return len(usable_cores())


def usable_cores() -> list[int]:
    """The cores that this process may use, by their numbers."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def thread_limits(threads: int) -> dict[str, str]:
    """Environment variables that hold XLA and NumPy to a number of threads; read when they are first imported."""
    names = ("NPROC", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    return dict.fromkeys(names, str(threads))


def available_memory() -> int | None:
    """Bytes that a new process can use, as far as the system says: free memory, or less inside a container."""
    limits = []
    meminfo = Path("/proc/meminfo")
    if meminfo.exists():
        entries = dict(line.split(":") for line in meminfo.read_text().splitlines())
        limits.append(int(entries["MemAvailable"].split()[0]) * 1024)
    elif "SC_AVPHYS_PAGES" in os.sysconf_names:
        limits.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    limit, used = Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")
    if limit.exists() and used.exists() and limit.read_text().strip() != "max":
        counted = Path("/sys/fs/cgroup/memory.stat")
        entries = dict(line.split() for line in counted.read_text().splitlines()) if counted.exists() else {}
        cached = int(entries.get("inactive_file", 0))  # of files, given up when memory is asked for
        limits.append(int(limit.read_text()) - int(used.read_text()) + cached)
    return min(limits, default=None)


def accelerator_plugins() -> bool:
    """Whether JAX has been installed for more than the CPU; whether there is such a device is another question."""
    return bool(entry_points(group="jax_plugins")) or find_spec("libtpu") is not None


def accelerator() -> bool:
    """Whether JAX finds an accelerator, asked in another process: this one may not want to take its memory."""
    if not accelerator_plugins():
        return False
    ask = [sys.executable, "-c", "import jax; print(jax.default_backend())"]
    answer = subprocess.run(ask, capture_output=True, text=True)
    return answer.returncode == 0 and answer.stdout.strip() not in ("", "cpu")


def processor_name() -> str:
    """The model, as compilers choose instructions by it; the architecture where the system does not tell more."""
    return processor_entry("model name") or platform.machine()


def processor_features() -> str:
    """All that compilers choose instructions by, as far as the system tells it."""
    return f"{platform.machine()} {processor_name()} {processor_entry('flags') or processor_entry('Features')}"


def processor_entry(name: str) -> str:
    """An entry of the first processor in Linux's list; empty where there is none."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text(errors="replace").splitlines() if information.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "")


def major(version: str | None) -> str:
    return re.split(r"[.+]", version)[0] if version else "unknown"


def other_simulation(saved: Mapping[str, str], current: Mapping[str, str]) -> str | None:
    """Why a run of these versions cannot go on with the current ones: it would be half of one task, half of another."""
    for package in SIMULATION_PACKAGES:
        then, now = saved.get(package), current[package]
        if then is not None and major(then) != major(now):
            return (
                f"{package} was {then} when the checkpoint was made and is {now} now, another simulation: go on with "
                f"pip install '{package}=={then}', or train anew under another name (--name)"
            )
    return None


def different_facts(saved: object, current: dict[str, Any]) -> list[str]:
    """Warnings for each version or machine fact that is not `current` but what a checkpoint was made with."""
    warnings = []
    for part, now in current.items():
        then = saved.get(part) if isinstance(saved, dict) else None
        for name, value in now.items():
            before = then.get(name) if isinstance(then, dict) else None
            if before == value:
                continue
            way_out = "; " + HOW_TO_MATCH[name].format(before) if name in HOW_TO_MATCH and before is not None else ""
            warnings.append(
                f"{name} was {'not recorded' if before is None else before} when the checkpoint was made and is "
                f"{value!s} now: results may differ in the last bits{way_out}"
            )
    return warnings
