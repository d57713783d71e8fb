"""Use a trained policy: evaluate it on fresh episodes, film it."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import DependencyNotInstalled

from saclab.environments.checked import CheckedEnvironment
from saclab.environments.make import EnvironmentSpec
from saclab.environments.wrappers import require_import_allowed
from saclab.errors import RunBroken, UserError, require
from saclab.files import absolute
from saclab.hub import is_address
from saclab.records import PolicyDescription
from saclab.trained_policy import TrainedPolicy, load_policy, on_disk, read_description
from saclab.training.evaluation import Evaluator
from saclab.training.failure import tell_of_closing, tracebacks_in

NEEDS_PYGAME = "it draws with pygame: pip install pygame"


class EvaluationResult(NamedTuple):
    """What `evaluate` found."""

    environment: str
    episodes: int
    mean_return: float
    standard_deviation: float
    total_rewards: list[float]
    lengths: list[int]

    def sentence(self) -> str:
        worst, best = min(self.total_rewards), max(self.total_rewards)
        return (
            f"{self.environment}: return {self.mean_return:.1f} ± {self.standard_deviation:.1f} over {self.episodes} "
            f"episodes (from {worst:.1f} to {best:.1f}), mean length {np.mean(self.lengths):.0f}"
        )


def evaluate(
    run: Path,
    episodes: int,
    seed: int,
    deterministic: bool = True,
    imports: Sequence[str] = (),
    left_in: Path | None = None,
) -> EvaluationResult:
    """Evaluate the best policy of a run, from its folder or from the Hugging Face Hub.

    Raises:
        UserError: if the run has no policy, or its environment would import a package not named in `imports`.
        RunBroken: if the environment raises an error, or breaks its word; a traceback is left in `left_in`; None for
            `run`, or for the working directory if that is hf:user/name.
    """
    require_seed(seed)
    run, left_in = on_disk(run), left_in or for_tracebacks(run)
    policy, description = load_policy(run), read_description(run)
    require_import_allowed(description.environment, description.wrappers, imports)
    seeds = np.random.SeedSequence(seed).generate_state(episodes).tolist()
    with tracebacks_in([left_in]):
        evaluator = Evaluator(description.environment, description.environment_arguments, description.wrappers)
        try:
            require_fit(policy, description.environment, evaluator.spec)
            result = evaluator.run(partial(policy.normalised_action, deterministic=deterministic), seeds)
        finally:
            tell_of_closing([(0, error) for error in evaluator.close()], [left_in])
    return EvaluationResult(
        description.environment, episodes, float(result.total_rewards.mean()), float(result.total_rewards.std()),
        result.total_rewards.tolist(), result.lengths.tolist(),
    )  # fmt: skip


def for_tracebacks(run: Path) -> Path:
    """Where an environment's traceback is left: the run's folder; the working directory for a policy of the Hub's."""
    return absolute("." if is_address(run) else run)


def require_seed(seed: int) -> None:
    """Raise SettingError for what is no seed."""
    require(0 <= seed < 2**63, "seed", seed, "use a whole number from 0 to 2**63 - 1")


def require_fit(policy: TrainedPolicy, environment: str, spec: EnvironmentSpec) -> None:
    """Raise UserError for a policy of another environment."""
    for name in ("observation_size", "action_size"):
        own, there = getattr(policy.spec, name), getattr(spec, name)
        if own != there:
            raise UserError(f"the policy is not one for {environment}: its {name} is {own}, and there it is {there}")


def record(
    run: Path,
    video: Path,
    steps: int,
    seed: int,
    size: int,
    imports: Sequence[str] = (),
    left_in: Path | None = None,
) -> str:
    """Film the best policy from the start of an episode, at the environment's own speed; says what was filmed.

    Raises:
        UserError: if the run has no policy, its environment would import a package not named in `imports`, or cannot
            be rendered here.
        RunBroken: if the environment raises an error, or breaks its word; a traceback is left in `left_in`; None for
            `run`, or for the working directory if that is hf:user/name.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    require_seed(seed)
    require(steps >= 1, "steps", steps, "film at least one step")
    run, left_in = on_disk(run), left_in or for_tracebacks(run)
    policy, description = load_policy(run), read_description(run)
    given, video = video, absolute(video)
    require_import_allowed(description.environment, description.wrappers, imports)
    require_place(video)
    with tracebacks_in([left_in]):
        environment = filmed_environment(description, size)
        try:
            require_fit(policy, description.environment, environment.spec)
            environment.reset(seed)
            require_rendering(environment)
            total_reward, filmed = film_to(video, environment, policy, steps, seed)
        finally:
            tell_of_closing([(0, error) for error in [environment.close()] if error], [left_in])
    return f"{given}: {filmed} steps, return {total_reward:.1f} until then"


def require_place(video: Path) -> None:
    """Raise UserError unless a film can be written there: what writes it would only break off."""
    try:
        video.parent.mkdir(parents=True, exist_ok=True)
        partial_of(video).touch()
        partial_of(video).unlink()
    except OSError as error:
        raise UserError(f"video = {str(video)!r}: {error.strerror or error}; name another file with --video") from error


def partial_of(video: Path) -> Path:
    return video.with_name(video.stem + ".partial" + video.suffix)


def film_to(
    video: Path, environment: CheckedEnvironment, policy: TrainedPolicy, steps: int, seed: int
) -> tuple[float, int]:
    """Film into a file, which is whole or not there; the return and the steps."""
    import imageio.v2 as imageio

    frames_per_second = environment.environment.metadata.get("render_fps", 30)
    partial = partial_of(video)
    if video.suffix.lower() == ".gif":
        options = {"duration": 1000 / frames_per_second, "loop": 0}  # milliseconds; players take 20 for the least
    else:
        options = {"fps": frames_per_second, "macro_block_size": 2, "quality": 6}
    try:
        with imageio.get_writer(partial, **options) as writer:
            filmed = film(environment, policy, writer, steps, seed)
        partial.replace(video)
    except ValueError as error:
        raise UserError(f"video = {str(video)!r}: {error}; use a name that ends in .mp4 or .gif") from error
    finally:
        partial.unlink(missing_ok=True)
    return filmed


def filmed_environment(description: PolicyDescription, size: int) -> CheckedEnvironment:
    """A policy's environment with a camera of `size` × `size` pixels, or with its own where it cannot be told one.

    Gymnasium's default camera stands still and the robot runs out of the picture: the one that MuJoCo's models call
    "track" follows it.
    """
    name, arguments = description.environment, description.environment_arguments
    view = {"camera_name": "track"} | arguments | {"width": size, "height": size}
    try:
        return CheckedEnvironment(name, view, "rgb_array", description.wrappers)
    except UserError:
        return CheckedEnvironment(name, arguments, "rgb_array", description.wrappers)


def require_rendering(environment: CheckedEnvironment) -> None:
    """Raise UserError, with what the renderer said, unless it can draw a frame."""
    try:
        frame = environment.render()
    except RunBroken as error:  # renderers fail in ways of their own: a missing library, package, display or driver
        if isinstance(error.__cause__, DependencyNotInstalled):
            raise UserError(f"{environment.name} cannot be filmed here: {NEEDS_PYGAME}") from error
        refused = UserError(
            f"{environment.name} cannot be filmed here: {error}; without a screen MuJoCo needs EGL (Debian: libegl1 "
            "and libgl1-mesa-dri) and MUJOCO_GL=egl"
        )
        refused.traceback = error.traceback
        raise refused from error
    if not isinstance(frame, np.ndarray):
        frames = type(frame).__name__
        raise UserError(f"{environment.name} cannot be filmed: its frames are {frames}, not arrays of pixels")


def film(
    environment: CheckedEnvironment, policy: TrainedPolicy, writer: Any, steps: int, seed: int
) -> tuple[float, int]:
    """Write one frame per step, until the episode ends or `steps` are done; the return and the steps."""
    observation = environment.reset(seed)
    total_reward, filmed = 0.0, 0
    while filmed < steps:
        writer.append_data(environment.render())
        action, _ = policy.predict(observation)
        observation, reward, terminated, truncated, _ = environment.step(action)
        total_reward += float(reward)
        filmed += 1
        if terminated or truncated:
            break
    return total_reward, filmed
