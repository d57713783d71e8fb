"""The page while its runs go on: made when it is asked for, and for this machine alone."""

from __future__ import annotations

import http.client
import socket
import struct
import threading

import pytest

from report.synthetic import write_run
from saclab.cli.main import main
from saclab.errors import SettingError
from saclab.report.watch import WatchedPage, is_own_host, server_of


@pytest.fixture
def ask(tmp_path):
    """`ask(path, host, method)` gives status and text of a server that watches `tmp_path`."""
    with server_of(WatchedPage([tmp_path], every=0), 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()

        def asked(path: str = "/", host: str | None = None, method: str = "GET") -> tuple[int, str]:
            connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
            connection.putrequest(method, path, skip_host=True)
            connection.putheader("Host", host or f"127.0.0.1:{server.server_port}")
            connection.endheaders()
            answer = connection.getresponse()
            text = answer.read().decode()
            connection.close()
            return answer.status, text

        yield asked
        server.shutdown()
        thread.join()


def test_a_page_is_made_anew_when_a_run_has_written_and_not_before(ask, tmp_path):
    status, text = ask()
    assert status == 200
    assert "Nothing to show yet" in text
    assert "no run folder" in text
    run = write_run(tmp_path, "sac", 0)
    _, first = ask()
    _, version = ask("/version")
    assert f'data-version="{version}"' in first
    assert "1 run: 1 variant" in first
    assert ask("/version")[1] == version
    with (run / "episodes.csv").open("a") as file:
        file.write(" ")
    assert ask("/version")[1] != version
    write_run(tmp_path, "averaged", 0)
    assert "2 runs: 2 variants" in ask()[1]


def test_it_is_made_at_most_once_in_so_many_seconds(tmp_path, monkeypatch):
    write_run(tmp_path, "sac", 0)
    watched, made = WatchedPage([tmp_path], every=3600), []
    monkeypatch.setattr(watched, "_made", lambda seen: made.append(seen) or ("page", "version"))
    for _ in range(3):
        assert watched.current() == ("page", "version")
        write_run(tmp_path, "averaged", len(made) + len(list(tmp_path.rglob("config.json"))))
    assert len(made) == 1


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "localhost:1", "[::1]"])
def test_a_request_under_another_name_is_refused(ask, host):
    assert ask("/", host)[0] == 403
    assert ask("/version", host)[0] == 403


def test_this_machines_own_names_are_answered(ask):
    assert ask("/version", "localhost")[0] == 200
    assert is_own_host("localhost:8642", 8642)
    assert not is_own_host("", 8642)


@pytest.mark.parametrize("path", ["/etc/passwd", "/..", "/%2e%2e/config.json", "/index.html", "/?x=1", "http://a/"])
def test_there_is_nothing_but_the_page(ask, path):
    assert ask(path)[0] == 404


def test_other_methods_change_nothing(ask):
    assert ask("/", method="HEAD") == (200, "")
    assert ask("/", method="POST")[0] == 501
    assert ask("/", method="DELETE")[0] == 501


def test_a_browser_that_goes_away_leaves_no_traceback(tmp_path, monkeypatch, capfd):
    asked, gone = threading.Event(), threading.Event()

    def page_when_gone(self) -> tuple[str, str]:
        asked.set()
        assert gone.wait(60)
        return "x" * 50_000_000, "version"

    monkeypatch.setattr(WatchedPage, "current", page_when_gone)
    with server_of(WatchedPage([tmp_path], 1), 0) as server:
        server.daemon_threads = False  # so that closing it waits for the answer
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        browser = socket.create_connection(("127.0.0.1", server.server_port))
        browser.sendall(f"GET / HTTP/1.0\r\nHost: localhost:{server.server_port}\r\n\r\n".encode())
        assert asked.wait(60)
        browser.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        browser.close()
        gone.set()
        server.shutdown()
        thread.join()
    assert capfd.readouterr().err == ""


def test_a_port_in_use_is_named_with_the_way_out(tmp_path, capsys):
    with server_of(WatchedPage([tmp_path], 1), 0) as server:
        with pytest.raises(SettingError, match=r"port = \d+: .*choose another with --port"):
            server_of(WatchedPage([tmp_path], 1), server.server_port)
        assert main(["watch", str(tmp_path), "--port", str(server.server_port)]) == 2
    assert main(["watch", str(tmp_path), "--port", "70000"]) == 2
    assert main(["watch", str(tmp_path), "--every", "-1"]) == 2
    assert "every = -1" in capsys.readouterr().err
