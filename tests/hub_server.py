"""The part of the Hugging Face Hub's protocol that saclab uses, on this machine's own address.

Written after what huggingface_hub 2.4 asks for, by its sources: repositories, the check of a card's metadata, commits,
files up by Git LFS's basic transfer, files down with a redirect for large ones. With the package hf_xet it would send
large files by the Hub's Xet transfer, which is not spoken here: clients have HF_HUB_DISABLE_XET=1.
"""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlparse

import yaml

TOKEN, USER = "hf_of_the_owner", "user"
LARGE = (".safetensors", ".onnx", ".mp4")
"""What goes by LFS, as in the .gitattributes that the Hub gives a new model."""


@dataclass
class Repository:
    private: bool
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    """Commit -> name -> content; the last one is main."""
    messages: list[str] = field(default_factory=list)

    def commit(self, files: dict[str, bytes], message: str) -> str:
        content = [(path, git_hash(files[path])) for path in sorted(files)]
        name = hashlib.sha1(f"{len(self.commits)} {message} {content}".encode()).hexdigest()
        self.commits[name] = files
        self.messages.append(message)
        return name

    @property
    def head(self) -> str:
        return list(self.commits)[-1]

    @property
    def files(self) -> dict[str, bytes]:
        return self.commits[self.head]


@dataclass
class Hub:
    """What the server holds, for tests to look at and to spoil."""

    repositories: dict[str, Repository] = field(default_factory=dict)
    large: dict[str, bytes] = field(default_factory=dict)
    """SHA-256 -> content."""
    asked: list[str] = field(default_factory=list)
    """Method and path of every request."""
    claimed_sizes: dict[str, int] = field(default_factory=dict)
    """Name -> a size that is told in place of its own."""

    def make(self, name: str, files: dict[str, bytes], private: bool = False) -> Repository:
        self.repositories[name] = Repository(private)
        self.repositories[name].commit({".gitattributes": b"*.safetensors filter=lfs\n"} | files, "initial commit")
        return self.repositories[name]


class Refused(Exception):  # noqa: N818 - it names what happened
    def __init__(self, status: int, code: str = "", said: str = "") -> None:
        self.status, self.code, self.said = status, code, said


class Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def handle_request(self) -> None:
        length = int(self.headers.get("Content-Length") or 0)
        self.body, url = self.rfile.read(length), urlparse(self.path)
        self.query, self.parts = parse_qs(url.query), [unquote(part) for part in url.path.strip("/").split("/")]
        self.hub.asked.append(f"{self.command} {url.path}")
        try:
            self.answer()
        except Refused as refused:
            headers = {"X-Error-Code": refused.code, "X-Error-Message": refused.said}
            self.send(refused.status, {"error": refused.said}, {name: text for name, text in headers.items() if text})

    do_GET = do_HEAD = do_POST = do_PUT = handle_request  # noqa: N815 - http.server's names

    def answer(self) -> None:
        match self.command, self.parts:
            case "POST", ["api", "repos", "create"]:
                self.create(json.loads(self.body))
            case "POST", ["api", "validate-yaml"]:
                self.validate(json.loads(self.body)["content"])
            case "POST", ["api", "models", user, name, "preupload", "main"]:
                self.preupload(self.writable(f"{user}/{name}"))
            case "POST", ["api", "models", user, name, "commit", "main"]:
                self.commit(f"{user}/{name}", self.writable(f"{user}/{name}"))
            case "GET", ["api", "models", user, name, *rest] if rest[:1] in ([], ["revision"]):
                self.describe(f"{user}/{name}", rest[1] if rest else "main")
            case "GET", ["api", "models", user, name, "tree", revision]:
                files = self.files(f"{user}/{name}", revision)[1]
                self.send(200, [{"type": "file", "path": path, **self.facts(path, files[path])} for path in files])
            case "POST", [_, _, "info", "lfs", "objects", "batch"]:
                self.owner()
                self.send(
                    200, {"transfer": "basic", "objects": list(map(self.upload_of, json.loads(self.body)["objects"]))}
                )
            case "PUT", ["lfs", oid]:
                assert hashlib.sha256(self.body).hexdigest() == oid
                self.hub.large[oid] = self.body
                self.send(200)
            case "POST", ["lfs", "verify"]:
                told = json.loads(self.body)
                self.send(200 if len(self.hub.large.get(told["oid"], b"")) == told["size"] else 404)
            case "GET", ["lfs", oid]:
                assert not self.known
                self.send(200, self.hub.large[oid])
            case "GET" | "HEAD", [user, name, "resolve", revision, *path]:
                self.resolve(*self.files(f"{user}/{name}", revision), "/".join(path))
            case _:
                raise Refused(404, said=f"nothing at {self.path}")

    # --- who may do what

    @property
    def known(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def owner(self) -> None:
        if not self.known:
            raise Refused(401, said="Invalid username or password.")

    def writable(self, name: str) -> Repository:
        self.owner()
        return self.repository(name)

    def repository(self, name: str) -> Repository:
        found = self.hub.repositories.get(name)
        if found is None or (found.private and not self.known):
            raise Refused(404 if self.known else 401, "RepoNotFound", "Repository not found")
        return found

    def files(self, name: str, revision: str) -> tuple[str, dict[str, bytes]]:
        repository = self.repository(name)
        commit = repository.head if revision == "main" else revision
        if commit not in repository.commits:
            raise Refused(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return commit, repository.commits[commit]

    # --- what is asked

    def create(self, wanted: dict[str, Any]) -> None:
        self.owner()
        name = f"{wanted.get('organization') or USER}/{wanted['name']}"
        if name.partition("/")[0] != USER:
            raise Refused(403, said="You don't have the rights to create a model under this namespace")
        there = name in self.hub.repositories
        if not there:
            private = wanted.get("private") or wanted.get("visibility") == "private"
            self.hub.make(name, {}, private=bool(private))
        self.send(409 if there else 200, {"url": f"{self.address}/{name}", "name": name})

    def validate(self, content: str) -> None:
        _, metadata, _ = content.split("---\n", 2)
        errors = [] if isinstance(yaml.safe_load(metadata), dict) else [{"message": "no metadata"}]
        self.send(400 if errors else 200, {"errors": errors, "warnings": []})

    def describe(self, name: str, revision: str) -> None:
        commit, files = self.files(name, revision)
        blobs = self.query.get("blobs", ["false"])[0].lower() == "true"
        siblings = [
            {"rfilename": path} | ({"size": self.facts(path, content)["size"]} if blobs else {})
            for path, content in files.items()
        ]
        private = self.hub.repositories[name].private
        self.send(
            200, {"id": name, "modelId": name, "sha": commit, "private": private, "siblings": siblings, "tags": []}
        )

    def facts(self, path: str, content: bytes) -> dict[str, Any]:
        size = self.hub.claimed_sizes.get(path, len(content))
        told: dict[str, Any] = {"size": size, "oid": git_hash(content)}
        if path.endswith(LARGE):
            told["lfs"] = {"oid": hashlib.sha256(content).hexdigest(), "size": size, "pointerSize": 130}
        return told

    def preupload(self, repository: Repository) -> None:
        files = json.loads(self.body)["files"]
        modes = [
            {
                "path": file["path"],
                "uploadMode": "lfs" if file["path"].endswith(LARGE) else "regular",
                "shouldIgnore": False,
                "oid": git_hash(repository.files[file["path"]]) if file["path"] in repository.files else None,
            }
            for file in files
        ]
        self.send(200, {"files": modes})

    def upload_of(self, wanted: dict[str, Any]) -> dict[str, Any]:
        """Where an object of LFS is put; nowhere if it is there."""
        if wanted["oid"] in self.hub.large:
            return wanted
        actions = {
            "upload": {"href": f"{self.address}/lfs/{wanted['oid']}", "header": {}},
            "verify": {"href": f"{self.address}/lfs/verify", "header": {}},
        }
        return wanted | {"actions": actions}

    def commit(self, name: str, repository: Repository) -> None:
        lines = [json.loads(line) for line in self.body.splitlines()]
        header, files = lines[0]["value"], dict(repository.files)
        if header.get("parentCommit", repository.head) != repository.head:
            raise Refused(412, said="A commit has happened since. Please refresh and try again.")
        for line in lines[1:]:
            value = line["value"]
            match line["key"]:
                case "file":
                    files[value["path"]] = base64.b64decode(value["content"])
                case "lfsFile":
                    files[value["path"]] = self.hub.large[value["oid"]]
                case "deletedFile":
                    del files[value["path"]]
                case key:
                    raise Refused(400, said=f"unknown operation {key}")
        made = repository.commit(files, header["summary"])
        self.send(200, {"success": True, "commitOid": made, "commitUrl": f"{self.address}/{name}/commit/{made}"})

    def resolve(self, commit: str, files: dict[str, bytes], path: str) -> None:
        headers = {"X-Repo-Commit": commit}
        if path not in files:
            raise Refused(404, "EntryNotFound", "Entry not found")
        content = files[path]
        if not path.endswith(LARGE):
            self.send(200, content, headers | {"ETag": f'"{git_hash(content)}"'})
            return
        oid = hashlib.sha256(content).hexdigest()
        self.hub.large[oid] = content
        linked = {
            "X-Linked-Etag": f'"{oid}"',
            "X-Linked-Size": str(len(content)),
            "Location": self.elsewhere(oid),
        }
        self.send(302, b"", headers | linked)

    # --- answers

    def elsewhere(self, oid: str) -> str:
        """Where a large file is: on another host, which must not be sent the token."""
        return f"{self.address.replace('127.0.0.1', 'localhost')}/lfs/{oid}"

    @property
    def address(self) -> str:
        return f"http://{self.headers['Host']}"

    def send(self, status: int, content: object = b"", headers: dict[str, str] | None = None) -> None:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        kind = "application/octet-stream" if isinstance(content, bytes) else "application/json"
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, *said: object) -> None:
        pass


def git_hash(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


@contextmanager
def served() -> Iterator[tuple[str, Hub]]:
    """The address of a Hub, and what it holds."""
    hub = Hub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Bound", (Handler,), {"hub": hub}))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", hub
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
