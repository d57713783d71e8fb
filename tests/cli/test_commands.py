"""Every command as a user runs it, in a process of its own."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from ctypes.util import find_library
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from saclab.trained_policy import load_policy, save_policy
from saclab.training.run_folder import read_config, read_run

from .conftest import Told

SMALL = ("--random-steps", "200", "--batch-size", "32", "--hidden-layers", "16", "16", "--evaluation-episodes", "2")
SHORT = (*SMALL, "--max-updates", "300", "--evaluation-interval-steps", "250", "--log-interval", "50")


def saclab(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in `folder`, one core, and no terminal."""
    return subprocess.run(
        [sys.executable, "-m", "saclab", *arguments], cwd=folder, capture_output=True, text=True, timeout=600
    )


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which a short comparison of two variants on Pendulum-v1 has been run."""
    folder = tmp_path_factory.mktemp("compared")
    result = saclab(
        "compare", "Pendulum-v1", "--variants", "sac", "averaged", "--protocol", "quick", "--seeds", "2", *SHORT,
        folder=folder,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return folder


def run_folder(folder: Path, variant: str = "sac", seed: int = 0) -> Path:
    return folder / "runs" / "Pendulum-v1" / variant / "quick" / f"seed-{seed}"


def test_compare_trains_the_grid_and_writes_the_report(trained: Path) -> None:
    for variant in ("sac", "averaged"):
        for seed in (0, 1):
            result = json.loads((run_folder(trained, variant, seed) / "result.json").read_text())
            assert result["updates"] == 300
    page = trained / "runs" / "report" / "index.html"
    assert "Pendulum-v1" in page.read_text()


@pytest.mark.slow
def test_a_name_makes_an_arm_of_other_settings(trained: Path) -> None:
    result = saclab(
        "compare", "Pendulum-v1", "--variants", "averaged", "--name", "averaged-far", "--snapshot-interval", "20",
        "--protocol", "quick", "--seeds", "1", *SHORT, "--runs", "named", folder=trained,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    report = saclab("report", "runs", "named", "--out", "arms", folder=trained)
    assert report.returncode == 0, report.stderr
    assert "| averaged-far | averaged | snapshot\\_interval 20 |" in (trained / "arms" / "report.md").read_text()
    assert (trained / "arms" / "index.html").is_file()


@pytest.mark.slow
def test_compare_again_skips_what_is_finished(trained: Path) -> None:
    before = (run_folder(trained) / "evaluations.csv").stat().st_mtime_ns
    result = saclab(
        "compare", "Pendulum-v1", "--variants", "sac", "averaged", "--protocol", "quick", "--seeds", "2", *SHORT,
        folder=trained,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert (run_folder(trained) / "evaluations.csv").stat().st_mtime_ns == before


def test_compare_gives_settings_to_every_run_and_keeps_variants(trained: Path) -> None:
    configs = [json.loads((run_folder(trained, v) / "config.json").read_text())["config"] for v in ("sac", "averaged")]
    assert [config["algorithm"]["batch_size"] for config in configs] == [32, 32]
    assert [config["algorithm"]["snapshots"] for config in configs] == [1, 10]


def test_evaluate_prints_the_return_of_the_best_policy(trained: Path) -> None:
    result = saclab("evaluate", str(run_folder(trained)), "--episodes", "3", "--json", folder=trained)
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    assert len(told["total_rewards"]) == 3
    assert told["mean_return"] == pytest.approx(np.mean(told["total_rewards"]))


@pytest.mark.slow
@pytest.mark.skipif(find_library("EGL") is None, reason="no EGL library to render with")
def test_record_films_the_best_policy_without_a_screen(tmp_path: Path) -> None:
    trained = saclab(
        "train", "Hopper-v4", "--protocol", "quick", *SMALL, "--max-updates", "20", "--evaluation-episodes", "1",
        folder=tmp_path,
    )  # fmt: skip
    assert trained.returncode == 0, trained.stderr
    run = tmp_path / "runs/Hopper-v4/sac-auto/quick/seed-0"
    filmed = saclab("record", str(run), "--video", "hopper.mp4", "--steps", "5", "--size", "64", folder=tmp_path)
    assert filmed.returncode == 0, filmed.stderr
    assert (tmp_path / "hopper.mp4").read_bytes()[4:8] == b"ftyp"
    filmed = saclab("record", str(run), "--video", "hopper.gif", "--steps", "5", "--size", "64", folder=tmp_path)
    assert filmed.returncode == 0, filmed.stderr
    assert len(imageio.mimread(tmp_path / "hopper.gif")) == 5
    refused = saclab("record", str(run), "--video", "hopper.xyz", "--steps", "5", "--size", "64", folder=tmp_path)
    assert refused.returncode == 2
    assert "hopper.xyz" in refused.stderr
    assert "use a name that ends in .mp4 or .gif" in refused.stderr


@pytest.mark.slow
@pytest.mark.parametrize("batch", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_reproduce_forecasts_trains_and_says_that_it_is_scaled_down(tmp_path: Path, batch: int) -> None:
    arguments = ("reproduce", "--environments", "Pendulum-v1", "--variants", "sac", "--seeds", "1", "--updates", "20",
                 "--batch", str(batch))  # fmt: skip
    result = saclab(*arguments, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "1 of 1 runs to do" in result.stdout
    assert re.search(r"forecast: about \d+ minutes with \d+ worker", result.stdout)
    run = read_run(tmp_path / "runs/Pendulum-v1/sac/paper/seed-0")
    assert (run.config.training.update_interval, run.config.training.acting_delay) == (5, 0)
    assert run.machine["batch"] == min(batch, 1)
    assert run.config.training.q_bias_episodes == 2
    assert len(run.q_bias["evaluation"]) == len(run.evaluations["evaluation"]) > 0
    assert "Scaled down" in (tmp_path / "runs/report/index.html").read_text()
    assert "runs to do" not in saclab(*arguments, folder=tmp_path).stdout, "nothing is left to do"


def test_variants_and_protocols_are_listed(saclab_again: Callable[..., Told]) -> None:
    variants = saclab_again("variants").output
    assert all(name in variants for name in ("sac", "sac-auto", "averaged", "averaged-auto", "averaged-entropy"))
    protocols = saclab_again("protocols").output
    assert all(name in protocols for name in ("paper", "standard", "quick"))


def test_help_shows_the_values_of_the_variant_and_protocol_named(saclab_again: Callable[..., Told]) -> None:
    told = saclab_again("train", "Humanoid-v4", "--variant", "averaged", "--protocol", "paper", "--help")
    assert told.status == 0
    words = " ".join(told.output.replace("│", " ").split())
    assert "(default: 1500000)" in words
    assert "initial-temperature FLOAT α, or its first value if it is learned. (default: 0.1)" in words


def test_settings_follow_the_environment_wherever_it_stands_on_the_line(tmp_path: Path) -> None:
    told = saclab(
        "train", "--seed", "3", "Humanoid-v4", "--protocol", "paper", "--variant", "sac", "--max-updates", "1",
        "--random-steps", "256", "--evaluation-episodes", "1", "--hidden-layers", "8", folder=tmp_path,
    )  # fmt: skip
    assert told.returncode == 0, told.stderr
    config = json.loads((tmp_path / "runs/Humanoid-v4/sac/paper/seed-3/config.json").read_text())["config"]
    assert config["algorithm"]["initial_temperature"] == 0.1
    assert config["training"]["patience_episodes"] == 750


@pytest.mark.slow
def test_train_stops_on_ctrl_c_and_resume_ends_as_if_nothing_had_happened(tmp_path: Path) -> None:
    arguments = ["Pendulum-v1", "--protocol", "quick", *SHORT, "--max-updates", "3000"]
    straight = saclab("train", *arguments, "--runs", "straight", folder=tmp_path)
    assert straight.returncode == 0, straight.stderr
    process = subprocess.Popen(
        [sys.executable, "-m", "saclab", "train", *arguments, "--runs", "stopped"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    stopped = tmp_path / "stopped/Pendulum-v1/sac-auto/quick/seed-0"
    wait_for(lambda: (stopped / "metrics.jsonl").exists() and (stopped / "metrics.jsonl").stat().st_size > 0)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 130, output
    assert f"saclab resume {stopped}" in output
    assert not (stopped / "result.json").exists()
    resumed = saclab("resume", str(stopped), folder=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    for name in ("evaluations.csv", "episodes.csv"):
        assert without_seconds(stopped / name) == without_seconds(tmp_path / "straight" / stopped.relative_to(
            tmp_path / "stopped") / name)  # fmt: skip


def wait_for(condition: object, seconds: float = 600) -> None:
    deadline = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def without_seconds(path: Path) -> list[str]:
    """Lines of a CSV without its last column, the wall-clock time."""
    return [line.rpartition(",")[0] for line in path.read_text().splitlines()]


@pytest.mark.slow
def test_one_failed_run_does_not_sink_the_others(tmp_path: Path) -> None:
    (tmp_path / "breaking.py").write_text(
        """
import gymnasium, numpy as np
from gymnasium.spaces import Box

class Breaking(gymnasium.Env):
    observation_space = Box(-np.inf, np.inf, (2,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.broken = False
        return np.zeros(2, np.float32), {}

    def step(self, action):
        value = np.nan if self.np_random.random() < 1 / 300 else 0.0
        return np.full(2, value, np.float32), 0.0, False, bool(self.np_random.random() < 0.05), {}

gymnasium.register("Breaking-v0", Breaking)
"""
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    result = subprocess.run(
        [sys.executable, "-m", "saclab", "compare", "breaking:Breaking-v0", "Pendulum-v1", "--variants", "sac",
         "--protocol", "quick", "--seeds", "1", *SHORT],
        cwd=tmp_path, capture_output=True, text=True, timeout=600, env=environment,
    )  # fmt: skip
    assert result.returncode == 1, result.stderr
    assert "not finite" in result.stdout
    assert (run_folder(tmp_path) / "result.json").exists()


@pytest.mark.parametrize("command", ["resume", "evaluate", "record", "play"])
def test_a_run_folder_alone_cannot_make_saclab_import_a_package(trained: Path, tmp_path: Path, command: str) -> None:
    run = tmp_path / "received"
    shutil.copytree(run_folder(trained), run)
    (run / "result.json").unlink()
    shutil.rmtree(run / "checkpoints")  # an enemy's checksums would be right
    path = run / "config.json"
    path.write_text(path.read_text().replace('"Pendulum-v1"', '"trap:Pendulum-v1"'))
    policy = load_policy(run)
    save_policy(run / "best", read_config(run), policy.spec, policy.parameters, {})
    (tmp_path / "trap.py").write_text("open('sprung', 'w').close()")
    refused = saclab(command, str(run), folder=tmp_path)
    assert refused.returncode == 2
    assert "--imports trap" in refused.stderr
    assert not (tmp_path / "sprung").exists()
    if command == "evaluate":
        allowed = saclab(command, str(run), "--episodes", "1", "--imports", "trap", folder=tmp_path)
        assert allowed.returncode == 0, allowed.stderr
        assert (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("train", "HalfCheeta-v4"), "did you mean 'HalfCheetah"),
        (("train", "Pendulum-v1", "--variant", "averagd"), "did you mean 'averaged'"),
        (("train", "Pendulum-v1", "--protocol", "papper"), "did you mean 'paper'"),
        (("train", "Pendulum-v1", "--snapshot", "3"), "--snapshots"),
        (("train", "CartPole-v1"), "actions are discrete"),
        (("train", "Pendulum-v1", "--snapshots", "-1"), "snapshots = -1"),
        (("train", "Pendulum-v1", "--random-steps", "100"), "--batch-size 100 or less"),
        (("train", "Pendulum-v1", "--replay-capacity", "900000000000"), "GiB"),
        (("train", "Pendulum-v1", "--environment-arguments", "{wrong"), "not JSON"),
        (("train", "Pendulum-v1", "--environment-arguments", '{"wrong": 1}'), "does not accept"),
        (("train", "no_such_package:Thing-v0"), "no_such_package"),
        (("resume", "nowhere"), "not a run folder"),
        (("evaluate", "nowhere"), "there is no folder "),
        (("report", "nowhere"), "no run folder"),
        (("compare", "Pendulum-v1", "--variants", "sac", "nonsense"), "unknown variant 'nonsense'"),
        (("compare", "Pendulum-v1", "--seeds", "0"), "seeds = 0"),
        (("evaluate", "nowhere", "--seed", "-1"), "seed = -1"),
        (("record", "nowhere", "--seed", "-1"), "seed = -1"),
        (("record", "nowhere", "--steps", "0"), "steps = 0"),
        (("play", "nowhere"), "there is no folder "),
        (("play", "nowhere", "--episodes", "0"), "episodes = 0"),
        (("train", "Pendulum-v1", "--name", "x" * 300), "use at most 200 letters"),
        (("resume", "x" * 300), "File name too long"),
        (("report", "x" * 300), "File name too long"),
        (("train", "Pendulum-v1", "--environment-arguments", '{"g": NaN}'), "not JSON"),
        (("train", "Pendulum-v1", "--target-entropy", "nan"), "use finite numbers"),
    ],
)
def test_bad_input_gets_a_clear_line_and_status_2(
    saclab_again: Callable[..., Told], tmp_path: Path, arguments: tuple[str, ...], expected: str
) -> None:
    told = saclab_again(*arguments, folder=tmp_path)
    assert told.status == 2
    assert expected in told.errors + told.output
    assert "Traceback" not in told.errors
    assert not (tmp_path / "runs").exists(), "nothing may be left behind"


def test_a_folder_with_other_settings_is_refused_and_kept(trained: Path, saclab_again: Callable[..., Told]) -> None:
    before = (run_folder(trained) / "config.json").read_bytes()
    told = saclab_again(
        "train", "Pendulum-v1", "--variant", "sac", "--protocol", "quick", *SHORT, "--discount", "0.9", folder=trained
    )
    assert told.status == 2
    assert "discount is 0.99 there, 0.9 here" in told.errors
    assert (run_folder(trained) / "config.json").read_bytes() == before


def test_a_run_in_use_is_refused_with_the_other_process_id(tmp_path: Path) -> None:
    arguments = ("train", "Pendulum-v1", "--protocol", "quick", *SMALL, "--max-updates", "1000000")
    first = subprocess.Popen(
        [sys.executable, "-m", "saclab", *arguments], cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        lock = tmp_path / "runs/Pendulum-v1/sac-auto/quick/seed-0/lock"
        wait_for(lambda: lock.exists() and lock.read_text() == str(first.pid))
        second = saclab(*arguments, folder=tmp_path)
    finally:
        first.kill()
        first.wait()
    assert second.returncode == 2
    assert f"in use by process {first.pid}" in second.stderr


def test_the_terminal_stays_clean_and_no_stray_file_is_left(tmp_path: Path) -> None:
    result = saclab(
        "train", "HalfCheetah-v4", "--protocol", "quick", *SMALL, "--max-updates", "20", "--evaluation-episodes", "1",
        folder=tmp_path,
    )  # fmt: skip
    assert result.returncode == 0
    assert result.stderr == ""
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
