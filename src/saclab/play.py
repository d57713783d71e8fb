"""Show a trained policy in a window, which is Gymnasium's own: MuJoCo's viewer, or pygame's."""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import DependencyNotInstalled

from saclab.environments.checked import CheckedEnvironment
from saclab.environments.wrappers import require_import_allowed
from saclab.errors import RunBroken, UserError
from saclab.playback import NEEDS_PYGAME, for_tracebacks, require_fit, require_seed
from saclab.trained_policy import TrainedPolicy, load_policy, on_disk, read_description
from saclab.training.failure import tell_of_closing, tracebacks_in


class Played(NamedTuple):
    """An episode that was shown to its end."""

    total_reward: float
    length: int


def play(
    run: Path, episodes: int | None, seed: int, deterministic: bool = True, imports: Sequence[str] = ()
) -> Iterator[Played]:
    """Show a run's best policy, episode by episode, at the environment's own speed.

    Args:
        run: the run folder, a folder that holds a policy, or hf:user/name.
        episodes: how many; None for no end. They start as those of `evaluate` with the same seed.
        seed: of their starts.
        deterministic: the mean action, in place of a sample.
        imports: packages that the run's environment may import.

    Yields:
        Each episode that ended, until the window is closed.

    Raises:
        UserError: if the run has no policy, its environment would import a package not named in `imports`, or there
            is no display to show it on.
        RunBroken: if the environment raises an error, or breaks its word; a traceback is left in `run`, or in the
            working directory if that is hf:user/name.
    """
    require_seed(seed)
    run, left_in = on_disk(run), for_tracebacks(run)
    policy, description = load_policy(run), read_description(run)
    require_import_allowed(description.environment, description.wrappers, imports)
    with tracebacks_in([left_in]):
        environment = CheckedEnvironment(
            description.environment, description.environment_arguments, "human", description.wrappers
        )
        try:
            require_fit(policy, description.environment, environment.spec)
            require_window(environment, starts(seed, 0))
            for number in islice(count(), episodes):
                played = play_episode(environment, policy, starts(seed, number), deterministic)
                if played is None:
                    return
                yield played
        finally:
            tell_of_closing([(0, error) for error in [environment.close()] if error], [left_in])


def starts(seed: int, number: int) -> int:
    """The seed of an episode's start."""
    return int(np.random.SeedSequence(seed).generate_state(number + 1)[number])


def require_window(environment: CheckedEnvironment, seed: int) -> None:
    """Open the window with the first state of an episode; raises UserError where there can be none."""
    name = environment.name
    no_display = UserError(f"{name} cannot be shown here: there is no display; film it: saclab record")
    if has_mujoco_viewer(environment) and not glfw_finds_display():  # MuJoCo's viewer would abort the process
        raise no_display
    if environment.environment.render_mode != "human":
        raise UserError(f"{name} cannot be shown: it opens no window; film it: saclab record")
    try:
        environment.reset(seed)
        environment.render()
    except RunBroken as error:
        if isinstance(error.__cause__, DependencyNotInstalled):  # of pygame, which only windows need
            raise UserError(f"{name} cannot be shown here: {NEEDS_PYGAME}") from error
        refused = UserError(f"{name} cannot be shown here: {error}; film it: saclab record")
        refused.traceback = error.traceback
        raise refused from error
    if pygame_draws_nowhere():
        raise no_display
    follow(environment)


def has_mujoco_viewer(environment: CheckedEnvironment) -> bool:
    return hasattr(environment.environment.unwrapped, "mujoco_renderer")


def glfw_finds_display() -> bool:
    """Whether GLFW, by which MuJoCo's viewer opens its window, finds a display with a monitor."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what GLFW says is said better
        try:
            import glfw
        except ImportError:
            return False
        return bool(glfw.init() and glfw.get_primary_monitor())


def pygame_draws_nowhere() -> bool:
    """Whether pygame, which finds no display, has taken a driver without one that nobody asked for."""
    pygame: Any = sys.modules.get("pygame")
    if pygame is None or not pygame.display.get_init():
        return False
    driver = pygame.display.get_driver()
    return driver in ("dummy", "offscreen") and driver != os.environ.get("SDL_VIDEODRIVER")


def follow(environment: CheckedEnvironment) -> None:
    """Look through the camera that MuJoCo's models call "track", if there is one: the robot stays in the picture."""
    if not has_mujoco_viewer(environment):
        return
    import mujoco

    inner: Any = environment.environment.unwrapped
    camera = mujoco.mj_name2id(inner.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
    if camera >= 0:
        inner.mujoco_renderer.viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
        inner.mujoco_renderer.viewer.cam.fixedcamid = camera


def window_is_closed(environment: CheckedEnvironment) -> bool:
    """Whether who looks on has closed it."""
    if has_mujoco_viewer(environment):
        import glfw

        inner: Any = environment.environment.unwrapped
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # with the key Escape the viewer has ended GLFW, which complains then
            return not glfw.get_current_context() or bool(glfw.window_should_close(inner.mujoco_renderer.viewer.window))
    pygame: Any = sys.modules.get("pygame")
    return pygame is not None and pygame.display.get_init() and bool(pygame.event.peek(pygame.QUIT))


def play_episode(
    environment: CheckedEnvironment, policy: TrainedPolicy, seed: int, deterministic: bool
) -> Played | None:
    """Show one episode, whose steps the environment draws; None if the window is closed before its end."""
    seconds = 1 / environment.environment.metadata.get("render_fps", 30)
    observation = environment.reset(seed)
    total_reward, length, due = 0.0, 0, time.monotonic()
    while not window_is_closed(environment):
        action, _ = policy.predict(observation, deterministic=deterministic)
        observation, reward, terminated, truncated, _ = environment.step(action)
        total_reward, length = total_reward + reward, length + 1
        if terminated or truncated:
            return Played(total_reward, length)
        due = max(due + seconds, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))
    return None
