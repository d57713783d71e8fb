"""The report's page while its runs go on, served to this machine's own browser.

It is made when it is asked for and the runs have changed, at most once in a while, so nothing is done that nobody looks
at. Requests are answered only for this machine's own names: a page of somebody else's, whose name leads here, reads
nothing.
"""

from __future__ import annotations

import hashlib
import sys
import threading
import time
from collections.abc import Sequence
from html import escape
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from saclab.errors import SettingError, UserError
from saclab.report.report import compared, page_of
from saclab.training.run_folder import find_runs

LOOPBACK = "127.0.0.1"
NAMES = ("127.0.0.1", "localhost")
WATCHED_FILES = (
    "config.json",
    "evaluations.csv",
    "episodes.csv",
    "metrics.jsonl",
    "q_bias.csv",
    "reward_terms.csv",
    "result.json",
)
WAITING = (
    '<!DOCTYPE html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="5"><title>saclab</title>'
    "<h1>Nothing to show yet</h1><p>{}</p>"
)


class WatchedPage:
    """The newest page of some folders' runs."""

    def __init__(self, roots: Sequence[Path], every: float, allow_mixed: bool = False) -> None:
        """`every` is the number of seconds in which the page is made at most once."""
        self.roots, self.every, self.allow_mixed = list(roots), every, allow_mixed
        self.lock = threading.Lock()
        self.looked_at = -float("inf")
        self.seen, self.version, self.page = "", "", ""

    def current(self) -> tuple[str, str]:
        """The page and its version, made anew if that is due."""
        with self.lock:
            if time.monotonic() - self.looked_at >= self.every:
                seen = self._state_of_files()
                if seen != self.seen:
                    self.page, self.version = self._made(seen)
                    self.seen = seen
                self.looked_at = time.monotonic()
            return self.page, self.version

    def _made(self, seen: str) -> tuple[str, str]:
        version = hashlib.sha256(seen.encode()).hexdigest()[:16]
        try:
            return page_of(compared(find_runs(self.roots), self.allow_mixed), version), version
        except UserError as error:
            return WAITING.format(escape(str(error))), version

    def _state_of_files(self) -> str:
        """What changes with every line that a run writes."""
        try:
            runs = find_runs(self.roots)
        except UserError as error:
            return str(error)
        found = []
        for run in runs:
            for name in WATCHED_FILES:
                try:
                    stat = (run / name).stat()
                except OSError:
                    continue
                found.append(f"{run / name} {stat.st_size} {stat.st_mtime_ns}")
        return "\n".join(found)


class Server(ThreadingHTTPServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away before its answer, as one does whose tab is closed, is no error."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def server_of(watched: WatchedPage, port: int) -> ThreadingHTTPServer:
    """A server that answers on the loopback address; port 0 is any free one. Raises SettingError for one in use."""

    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "saclab", ""

        def do_GET(self) -> None:
            if not is_own_host(self.headers.get("Host", ""), self.server.server_port):  # type: ignore[attr-defined]
                self.answer(403, "text/plain", "this server answers for 127.0.0.1 and localhost only\n")
            elif self.path == "/":
                self.answer(200, "text/html", watched.current()[0])
            elif self.path == "/version":
                self.answer(200, "text/plain", watched.current()[1])
            else:
                self.answer(404, "text/plain", "there is the page alone: /\n")

        do_HEAD = do_GET  # noqa: N815 - as the standard library calls it

        def answer(self, status: int, kind: str, text: str) -> None:
            content = text.encode()
            self.send_response(status)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Cross-Origin-Resource-Policy", "same-origin")
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(content)

        def log_message(self, format: str, *arguments: object) -> None:
            """Say nothing: the terminal shows where the page is."""

    try:
        return Server((LOOPBACK, port), Handler)
    except (OSError, OverflowError) as error:
        raise SettingError("port", port, f"{error}; choose another with --port, or 0 for any that is free") from error


def is_own_host(host: str, port: int) -> bool:
    """Whether a request's Host header names this machine: guards against names that somebody else lets lead here."""
    name, _, given = host.rpartition(":") if ":" in host else (host, "", "")
    return name in NAMES and given in ("", str(port))
