"""A process that trains: what it compiles is kept for the next one, and changes nothing."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from saclab.training import process

TRAIN = """
import sys
from pathlib import Path
import numpy as np
from saclab.protocols import make_config
from saclab.training.loop import train
settings = dict(hidden_layers=(16,), batch_size=8, random_steps=8, max_steps=40, evaluation_interval_steps=100,
                evaluation_episodes=1)
for event in train(make_config("Pendulum-v1", "averaged-auto", overrides=settings), Path(sys.argv[1])):
    pass
"""


WORK_AGAIN = """
import resource
import numpy as np
from saclab.training.process import prepare_process
prepare_process()
for _ in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    work = np.empty(300 * 2**20, np.uint8)
    work.fill(1)
    del work
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def trained(folder: Path, cache: Path, **more: str) -> tuple[str, str]:
    """Checksum of the learner at the end of a training in a process of its own; what it said."""
    plain = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    done = subprocess.run(
        [sys.executable, "-c", TRAIN, str(folder)], capture_output=True, text=True, check=True,
        env={**plain, "XDG_CACHE_HOME": str(cache), "JAX_PLATFORMS": "cpu", **more},
    )  # fmt: skip
    (learner,) = folder.glob("checkpoints/*/learner.safetensors")
    return hashlib.sha256(learner.read_bytes()).hexdigest(), done.stderr


def entries(cache: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in cache.glob("saclab/xla/*/*-cache")}


@pytest.mark.slow
def test_what_is_compiled_is_kept_and_gives_the_same_bits(tmp_path):
    fresh, _ = trained(tmp_path / "without", tmp_path / "no", JAX_ENABLE_COMPILATION_CACHE="false")
    assert not entries(tmp_path / "no")
    first, _ = trained(tmp_path / "first", tmp_path)
    kept = entries(tmp_path)
    assert kept
    second, said = trained(tmp_path / "second", tmp_path)
    assert entries(tmp_path) == kept
    assert said == ""
    assert fresh == first == second


@pytest.mark.slow
def test_a_damaged_entry_is_compiled_again(tmp_path):
    first, _ = trained(tmp_path / "first", tmp_path)
    for path in tmp_path.glob("saclab/xla/*/*-cache"):
        path.write_bytes(path.read_bytes()[:1000])
    second, _ = trained(tmp_path / "second", tmp_path)
    assert first == second


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc is told so where it is glibc's")
def test_what_16_averaged_runs_work_in_is_kept_when_it_is_free():
    done = subprocess.run([sys.executable, "-c", WORK_AGAIN], capture_output=True, text=True, check=True)
    first, again = map(int, done.stdout.split())
    assert first > 300 * 2**20 // 2**21, "all of it was new"
    assert again < 10, "page faults"


def test_another_number_of_threads_has_a_folder_of_its_own(monkeypatch):
    folders = set()
    for threads in ("1", "2"):
        monkeypatch.setenv("NPROC", threads)
        folders.add(process.compilation_cache_folder())
    assert len(folders) == 2


def test_a_folder_of_the_users_own_is_respected(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    users = {"jax_enable_compilation_cache": True, "jax_compilation_cache_dir": str(tmp_path / "mine")}
    before = {name: getattr(jax.config, name) for name in users}
    try:
        for name, value in users.items():
            jax.config.update(name, value)
        process.use_compilation_cache()
        assert {name: getattr(jax.config, name) for name in users} == users
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
    assert not any(tmp_path.iterdir())
