"""A worker's process: how it is asked, how it ends, and that it can be made to die with its launcher."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from resume.helpers import wait_for

from saclab.grid.worker_process import WorkerProcess
from saclab.signals import end_of
from saclab.training.lock import locked, wait_until_free

CHILD = "import os, sys, time; sys.path[:0] = {path!r}; from saclab.signals import die_with; {then}"


def worker(folder: Path, program: str, monkeypatch: pytest.MonkeyPatch) -> WorkerProcess:
    """A worker process that runs this in place of training."""
    (folder / "sitecustomize.py").write_text(f"import os, sys, time\n{program}\nsys.stdout.flush()\nos._exit(0)\n")
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
    return WorkerProcess({"runs": [{"folder": str(folder / "run")}]}, {"THREADS": "3"}, str(folder))


def test_a_poll_brings_what_was_said_and_how_the_worker_ended(tmp_path, monkeypatch):
    program = """print('{"run": 0, "threads": %s, "in": "%s"}' % (os.environ["THREADS"], os.getcwd()))
print("oh no", file=sys.stderr)
sys.stdout.flush(); sys.stderr.flush(); os._exit(7)"""
    told = worker(tmp_path, program, monkeypatch).poll(60)
    assert told == {"messages": [{"run": 0, "threads": 3, "in": str(tmp_path)}], "code": 7, "errors": "oh no\n"}


def test_a_poll_does_not_wait_for_the_end(tmp_path, monkeypatch):
    process = worker(tmp_path, "time.sleep(60)", monkeypatch)
    began = time.monotonic()
    assert process.poll(0.2) == {"messages": [], "code": None, "errors": None}
    assert time.monotonic() - began < 10
    process.finish()
    assert process.process.returncode == -15


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lets a process die with another")
def test_a_worker_dies_at_once_with_its_launcher():
    child = CHILD.format(path=sys.path, then="die_with(os.getppid()); print(os.getpid(), flush=True); time.sleep(60)")
    launcher = subprocess.Popen(
        [sys.executable, "-c", f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert launcher.stdout is not None
    number = int(launcher.stdout.readline())
    launcher.kill()
    launcher.wait()
    state = Path(f"/proc/{number}/stat")
    wait_for(lambda: not state.exists() or ") Z" in state.read_text(), seconds=30)


def test_a_worker_whose_launcher_is_gone_does_not_begin():
    child = CHILD.format(path=sys.path, then="die_with(1); print('begun')")
    ended = subprocess.run([sys.executable, "-c", child], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert "started this one, 1, is gone" in ended.stderr


def test_a_run_folder_that_is_in_use_is_waited_for(tmp_path):
    held, release = threading.Event(), threading.Event()

    def hold() -> None:
        with locked(tmp_path):
            held.set()
            release.wait(10)

    holder = threading.Thread(target=hold)
    holder.start()
    held.wait(10)
    waiter = threading.Thread(target=wait_until_free, args=(tmp_path, 30))
    waiter.start()
    time.sleep(0.2)
    assert waiter.is_alive()
    release.set()
    waiter.join(10)
    assert not waiter.is_alive()
    holder.join()
    assert (tmp_path / "lock").read_text() == str(os.getpid())


def test_of_a_long_log_the_end_is_read(tmp_path):
    with (tmp_path / "log").open("w+") as log:
        log.write("ä" * 100_000 + "\nlast words\n")
        end = end_of(log)
    assert end.endswith("ä\nlast words\n")
    assert len(end) < 70_000
