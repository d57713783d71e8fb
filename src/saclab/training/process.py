"""How a process is set up for training: it keeps the memory it has freed, and compiles nothing twice."""

from __future__ import annotations

import ctypes
import gc
import hashlib
import os
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache
from jaxlib import version as jaxlib_version

from saclab.files import absolute
from saclab.machine import COMPILER_OPTIONS, accelerator_plugins, processor_features, visible_threads

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # of glibc's malloc.h
KEPT_BYTES = 2**30  # a group of 16 averaged runs works in more than 2**28; the largest replay buffers still go back
WORTH_KEEPING_SECONDS = 0.1


def device_name() -> str:
    """What XLA computes on, such as `cpu` or `2 × NVIDIA H200`."""
    devices = jax.devices()
    return f"{len(devices)} × {devices[0].device_kind}" if len(devices) > 1 else str(devices[0].device_kind)


def compiled(function: Callable[..., Any], donate_argnums: int | tuple[int, ...] = ()) -> Callable[..., Any]:
    """`jax.jit` as saclab's programs need it."""
    options = COMPILER_OPTIONS if jax.default_backend() == "cpu" else {}
    return jax.jit(function, donate_argnums=donate_argnums, compiler_options=options)


@lru_cache(maxsize=1)
def prepare_process() -> None:
    """Set this process up, once; the results of a run do not depend on it."""
    keep_freed_memory()
    collect_cycles_rarely()
    use_deterministic_kernels()
    use_compilation_cache()


def keep_freed_memory() -> None:
    """Let malloc reuse what XLA frees after every update, in place of returning it to the system.

    Otherwise an update may begin with thousands of page faults. Done where the C library is glibc.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_ARENA_MAX, 1)  # the others give a part back as soon as all of it is free


def collect_cycles_rarely() -> None:
    """Let Python look for unreachable cycles once in 50,000 new objects, in place of 700.

    Each look walks through the many thousand objects that JAX keeps, some 2 % of the samples that `perf record` took of
    a training on HalfCheetah-v4; a step makes no cycle.
    """
    _, *older = gc.get_threshold()
    gc.set_threshold(50_000, *older)


def use_deterministic_kernels() -> None:
    """On a GPU, hold XLA to kernels that give the same bits every time, unless XLA_FLAGS says something of it."""
    flags = os.environ.get("XLA_FLAGS", "")
    if accelerator_plugins() and "xla_gpu_deterministic_ops" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_deterministic_ops=true".strip()


def use_compilation_cache() -> None:
    """Keep what XLA compiles in the user's cache folder, unless JAX has been told of a folder or to keep nothing."""
    config: Any = jax.config
    if config.jax_compilation_cache_dir or not config.jax_enable_compilation_cache:
        return
    folder = compilation_cache_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return
    config.update("jax_compilation_cache_dir", str(folder))
    config.update("jax_persistent_cache_min_compile_time_secs", WORTH_KEEPING_SECONDS)
    compilation_cache.reset_cache()  # what was compiled before may have made up JAX's mind


def compilation_cache_folder() -> Path:
    """One for each version of jaxlib, processor and number of threads: its machine code is for no other."""
    user_cache = absolute(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    made_for = f"{processor_features()} {visible_threads('NPROC')}"
    digest = hashlib.sha256(made_for.encode()).hexdigest()[:12]
    return user_cache / "saclab" / "xla" / f"jaxlib-{jaxlib_version.__version__}-{digest}"
