"""Pipes that are closed, a full disk, few characters, no colours: no command ends of what cannot be shown."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
from pathlib import Path

import pytest

SHORT = ("--protocol", "quick", "--random-steps", "100", "--batch-size", "16", "--hidden-layers", "8",
         "--evaluation-episodes", "1", "--max-updates", "60", "--evaluation-interval-steps", "100")  # fmt: skip
TRAIN = ("train", "Pendulum-v1", *SHORT)
COMPARE = ("compare", "Pendulum-v1", "--variants", "sac", *SHORT)
RUN = Path("runs/Pendulum-v1/sac-auto/quick/seed-0")
SAYING = [("variants",), ("protocols",), ("train", "--help")]
HEAVY = [pytest.param(words, marks=pytest.mark.slow)  # they import what takes seconds
         for words in (("report", "nowhere"), ("evaluate", "nowhere"), ("resume", "nowhere"))]  # fmt: skip
ESCAPE = b"\x1b"


def shell(line: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[bytes]:
    """A line of bash in which $saclab is the command."""
    saclab = f"{sys.executable} -m saclab"
    return subprocess.run(
        ["bash", "-c", line], cwd=folder, capture_output=True, timeout=600,
        env={**os.environ, "saclab": saclab, **variables},
    )  # fmt: skip


def on_a_terminal(folder: Path, *arguments: str, **variables: str) -> tuple[int, bytes]:
    """Exit status, and what a terminal has been sent."""
    terminal, end = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "saclab", *arguments], cwd=folder, stdin=end, stdout=end, stderr=end,
        env={**os.environ, "TERM": "xterm", **variables},
    )  # fmt: skip
    os.close(end)
    seen = b""
    while process.poll() is None or select.select([terminal], [], [], 0)[0]:
        if select.select([terminal], [], [], 0.1)[0]:
            try:
                seen += os.read(terminal, 65536)
            except OSError:  # the other end is closed
                break
    os.close(terminal)
    return process.wait(), seen


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run that was trained while nobody read more than its first line."""
    folder = tmp_path_factory.mktemp("trained")
    told = shell(f"$saclab {' '.join(TRAIN)} | head -n 1; exit ${{PIPESTATUS[0]}}", folder)
    assert (told.returncode, told.stderr) == (0, b"")
    assert told.stdout.count(b"\n") == 1
    return folder


def test_a_run_goes_on_when_its_pipe_is_closed(trained):
    assert (trained / RUN / "result.json").is_file()
    assert list((trained / RUN / "checkpoints").glob("step-*"))


@pytest.mark.parametrize("words", [*SAYING, *HEAVY], ids=" ".join)
def test_who_closes_a_pipe_is_told_no_more(tmp_path, words):
    told = shell(f"$saclab {' '.join(words)} 2>&1 | true; exit ${{PIPESTATUS[0]}}", tmp_path)
    assert (told.returncode, told.stdout + told.stderr) == (2 if words[-1] == "nowhere" else 0, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("words", SAYING, ids=" ".join)
def test_what_cannot_be_written_is_told_once(tmp_path, words):
    told = shell(f"$saclab {' '.join(words)} > /dev/full", tmp_path)
    assert told.returncode == 1
    assert told.stderr.startswith(b"saclab: cannot write to standard output (No space left on device)")
    assert told.stderr.count(b"\n") == 1


@pytest.mark.parametrize("words", [*SAYING, *HEAVY], ids=" ".join)
def test_streams_that_were_never_open_are_no_failure(tmp_path, words):
    told = shell(f"$saclab {' '.join(words)} <&- >&- 2>&-", tmp_path)
    assert told.returncode == (2 if words[-1] == "nowhere" else 0)


READING = [pytest.param(words, marks=pytest.mark.slow)
           for words in (("evaluate", str(RUN), "--episodes", "2"), ("report", "runs"))]  # fmt: skip


@pytest.mark.parametrize("words", [*SAYING, *READING, *HEAVY], ids=" ".join)
def test_a_terminal_of_few_characters_is_no_failure(trained, words):
    told = shell(f"$saclab {' '.join(words)}", trained, PYTHONIOENCODING="ascii", LC_ALL="C")
    assert told.returncode == (2 if words[-1] == "nowhere" else 0)
    assert b"Traceback" not in told.stderr
    (told.stdout + told.stderr).decode("ascii")
    assert told.stdout or told.stderr


PLAIN = [{"NO_COLOR": "1"}, {"TERM": "dumb"}, {"NO_COLOR": "1", "PYTHONIOENCODING": "ascii"}]


@pytest.mark.parametrize("variables", PLAIN, ids=str)
@pytest.mark.parametrize("words", [("variants",), ("train", "--help"), HEAVY[0]], ids=" ".join)
def test_a_plain_terminal_gets_no_escapes(tmp_path, words, variables):
    status, seen = on_a_terminal(tmp_path, *words, **variables)
    assert status == (2 if words[-1] == "nowhere" else 0)
    assert len(seen) > 20
    assert ESCAPE not in seen


def test_any_other_terminal_gets_colours(tmp_path):
    """So that the test above can fail."""
    assert ESCAPE in on_a_terminal(tmp_path, "variants")[1]


# --- the commands that train, each in every way


HOW = {
    "a closed pipe": ("{} 2>&1 | head -n 1; exit ${{PIPESTATUS[0]}}", 0),
    "streams that were never open": ("{} <&- >&- 2>&-", 0),
    "few characters": ("PYTHONIOENCODING=ascii LC_ALL=C {}", 0),
    "a full disk": ("{} > /dev/full", 1),
}


@pytest.mark.slow
@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("more", ["", "--batch 2"], ids=["workers", "a group"])
def test_grids_end_well_whatever_becomes_of_their_output(tmp_path, how, more):
    line, status = HOW[how]
    told = shell(line.format(f"$saclab {' '.join(COMPARE)} {more}"), tmp_path)
    assert told.returncode == status, told.stderr
    assert b"Traceback" not in told.stderr + told.stdout
    assert (tmp_path / "runs/Pendulum-v1/sac/quick/seed-0/result.json").is_file()
    assert (tmp_path / "runs/report/index.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["streams that were never open", "few characters", "a full disk"])
def test_a_run_ends_well_whatever_becomes_of_its_output(tmp_path, how):
    line, status = HOW[how]
    told = shell(line.format(f"$saclab {' '.join(TRAIN)}"), tmp_path)
    assert told.returncode == status, told.stderr
    assert b"Traceback" not in told.stderr
    assert (tmp_path / RUN / "result.json").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("words", [TRAIN, COMPARE], ids=["train", "compare"])
@pytest.mark.parametrize("variables", PLAIN, ids=str)
def test_training_on_a_plain_terminal_sends_no_escapes(tmp_path, words, variables):
    status, seen = on_a_terminal(tmp_path, *words, **variables)
    assert status == 0, seen
    assert b"finished" in seen
    assert ESCAPE not in seen


def test_ctrl_c_is_not_lost_where_there_is_nothing_to_save() -> None:
    """A KeyboardInterrupt that is raised in a callback is ignored by Python; this is none."""
    program = (
        "import os, signal, weakref\n"
        "from saclab.signals import end_at_once_on_ctrl_c\n"
        "end_at_once_on_ctrl_c()\n"
        "class Thing: pass\n"
        "thing = Thing()\n"
        "reference = weakref.ref(thing, lambda _: os.kill(os.getpid(), signal.SIGINT))\n"
        "del thing\n"
        "print('went on')\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "saclab: interrupted\n")
