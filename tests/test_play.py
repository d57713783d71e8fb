"""A policy in a window. Without a display the window is pygame's dummy one, and MuJoCo's viewer is refused."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from test_playback import ONE, SIX, saved_policy

from saclab.environments.make import EnvironmentSpec
from saclab.errors import UserError
from saclab.play import Played, play
from saclab.playback import evaluate

HAS_PYGAME = importlib.util.find_spec("pygame") is not None


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)


def pendulum(folder: Path) -> Path:
    """A policy for episodes of 20 steps."""
    return saved_policy(
        folder, "Pendulum-v1", {"max_episode_steps": 20}, EnvironmentSpec(3, 1, -2 * ONE, 2 * ONE)
    )  # fmt: skip


@pytest.mark.usefixtures("no_display")
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have a display always")
def test_without_a_display_the_way_to_a_film_is_told(tmp_path: Path) -> None:
    saved_policy(tmp_path, "HalfCheetah-v4", {}, EnvironmentSpec(17, 6, -SIX, SIX))
    with pytest.raises(UserError, match=r"HalfCheetah-v4 cannot be shown here: there is no display.*saclab record"):
        next(play(tmp_path, 1, 0))


@pytest.mark.skipif(HAS_PYGAME, reason="pygame is installed")
def test_a_window_that_needs_pygame_says_so(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"Pendulum-v1 cannot be shown here: .*pygame is not installed, run"):
        next(play(pendulum(tmp_path), 1, 0))
    assert not (tmp_path / "traceback.txt").exists()


@pytest.mark.usefixtures("no_display")
@pytest.mark.skipif(not HAS_PYGAME, reason="pygame is not installed")
def test_what_pygame_draws_where_nobody_sees_it_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"Pendulum-v1 cannot be shown here: there is no display"):
        next(play(pendulum(tmp_path), 1, 0))


@pytest.mark.skipif(not HAS_PYGAME, reason="pygame is not installed")
def test_the_episodes_are_those_of_evaluate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    run = pendulum(tmp_path)
    played, evaluated = list(play(run, 2, 5)), evaluate(run, 2, 5)
    assert [episode.length for episode in played] == evaluated.lengths == [20, 20]
    np.testing.assert_allclose([episode.total_reward for episode in played], evaluated.total_rewards, rtol=1e-6)


@pytest.mark.skipif(not HAS_PYGAME, reason="pygame is not installed")
def test_it_ends_when_the_window_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    episodes = play(pendulum(tmp_path), None, 0)
    assert isinstance(next(episodes), Played)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert list(episodes) == []
