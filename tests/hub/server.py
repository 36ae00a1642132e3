"""A Hub on 127.0.0.1 that keeps repositories in memory: as much of one as huggingface_hub asks for."""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

import yaml

TOKEN = "hf_loopbackDummyTokenForTests0123456"
LFS_ENDINGS = (".safetensors", ".parquet", ".mp4", ".png")
FIRST = "0" * 40
POLL_S = 0.01  # how soon the server notices that it is to end


class HubError(Exception):
    """An answer of the Hub that is an error: (status, X-Error-Code, message)."""


@dataclass
class Repository:
    """Commits are whole trees: {path: content}."""

    commits: dict[str, dict[str, bytes]] = field(default_factory=lambda: {FIRST: {}})
    refs: dict[str, str] = field(default_factory=lambda: {"main": FIRST})
    tags: set[str] = field(default_factory=set)
    is_private: bool = False
    messages: list[str] = field(default_factory=list)

    def sha(self, revision: str) -> str:
        sha = self.refs.get(revision, revision)
        if sha not in self.commits:
            raise HubError(404, "RevisionNotFound", f"no revision {revision}")
        return sha

    def files(self, revision: str = "main") -> dict[str, bytes]:
        return self.commits[self.sha(revision)]

    def commit(self, files: dict[str, bytes], message: str) -> str:
        sha = hashlib.sha1(f"{len(self.commits)}{message}".encode()).hexdigest()
        self.commits[sha] = files
        self.refs["main"] = sha
        self.messages.append(message)
        return sha


class LoopbackHub:
    """Repositories by "models/me/x" or "datasets/me/d", and what was asked."""

    def __init__(self) -> None:
        self.repositories: dict[str, Repository] = {}
        self.blobs: dict[str, bytes] = {}
        self.requests: list[str] = []  # "GET /path"
        self.cards: list[str] = []  # that were validated
        self.betrayals: list[str] = []  # requests that hold the token elsewhere than in their Authorization
        self.before: Callable[[str], None] | None = None  # what happens just before a request is answered
        self.endpoint = ""

    def model(self, repo_id: str) -> Repository:
        return self.repositories[f"models/{repo_id}"]

    def dataset(self, repo_id: str) -> Repository:
        return self.repositories[f"datasets/{repo_id}"]

    def find(self, key: str) -> Repository:
        if key not in self.repositories:
            raise HubError(404, "RepoNotFound", f"no repository {key}")
        return self.repositories[key]

    @contextmanager
    def served(self) -> Iterator["LoopbackHub"]:
        handler = type("Handler", (_Handler,), {"hub": self})
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        server.daemon_threads = True
        self.endpoint = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, args=(POLL_S,), daemon=True)
        thread.start()
        try:
            yield self
        finally:
            server.shutdown()
            server.server_close()
            thread.join()


def git_oid(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def content_id(path: str, content: bytes) -> str:
    """Return the id of a file's content; a client does not send the same content again."""
    return hashlib.sha256(content).hexdigest() if path.endswith(LFS_ENDINGS) else git_oid(content)


def described(path: str, content: bytes) -> dict:
    """A file as the tree names it."""
    entry = {"type": "file", "path": path, "size": len(content), "oid": git_oid(content)}
    if path.endswith(LFS_ENDINGS):
        entry["lfs"] = {"oid": content_id(path, content), "size": len(content), "pointerSize": 130}
    return entry


class _Handler(BaseHTTPRequestHandler):
    """One request; ROUTES says which method answers."""

    hub: LoopbackHub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        self._answer()

    do_HEAD = do_POST = do_PUT = do_DELETE = do_GET  # noqa: N815

    def _answer(self) -> None:
        path = unquote(urlsplit(self.path).path)
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        method = "GET" if self.command == "HEAD" else self.command
        self.hub.requests.append(f"{self.command} {path}")
        others = [value for name, value in self.headers.items() if name.lower() != "authorization"]
        if TOKEN.encode() in self.body or TOKEN in f"{self.path} {others}":
            self.hub.betrayals.append(path)
        try:
            if self.hub.before is not None:
                self.hub.before(f"{self.command} {path}")
            for verb, pattern, name in ROUTES:
                match = re.fullmatch(pattern, path) if verb == method else None
                if match is not None:
                    self._check_token(name)
                    return getattr(self, name)(**match.groupdict())
            raise HubError(404, "NotImplemented", f"the loopback Hub does not know {self.command} {path}")
        except HubError as error:
            status, code, message = error.args
            self._send(status, message.encode(), {"X-Error-Code": code, "X-Error-Message": message})

    def _check_token(self, name: str) -> None:
        is_write = self.command in ("POST", "DELETE") and name not in ("validate", "paths_info")
        if is_write and self.headers.get("Authorization") != f"Bearer {TOKEN}":
            raise HubError(401, "Unauthorized", "Invalid username or password.")

    def _send(self, status: int, content: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _json(self, values: object, status: int = 200) -> None:
        self._send(status, json.dumps(values).encode(), {"Content-Type": "application/json"})

    # Writing

    def create(self) -> None:
        asked = json.loads(self.body)
        name = f"{asked['organization']}/{asked['name']}" if asked.get("organization") else asked["name"]
        key = f"{asked.get('type') or 'model'}s/{name}"
        status = 409 if key in self.hub.repositories else 200
        self.hub.repositories.setdefault(key, Repository(is_private=asked.get("visibility") == "private"))
        prefix = "datasets/" if key.startswith("datasets/") else ""
        self._json({"url": f"{self.hub.endpoint}/{prefix}{name}", "name": name, "id": name}, status)

    def validate(self) -> None:
        content = json.loads(self.body)["content"]
        parts = content.split("---\n", 2)
        if len(parts) != 3 or not yaml.safe_load(parts[1]):
            raise HubError(400, "BadRequest", "the card has no metadata")
        self.hub.cards.append(content)
        self._json({"errors": [], "warnings": []})

    def preupload(self, key: str, revision: str) -> None:
        there = self.hub.find(key).files(revision)
        files = [
            {
                "path": path,
                "uploadMode": "lfs" if path.endswith(LFS_ENDINGS) else "regular",
                "shouldIgnore": False,
                "oid": content_id(path, there[path]) if path in there else None,
            }
            for path in (each["path"] for each in json.loads(self.body)["files"])
        ]
        self._json({"files": files})

    def lfs_batch(self, key: str) -> None:
        self.hub.find(key if key.startswith("datasets/") else f"models/{key}")
        objects = []
        for each in json.loads(self.body)["objects"]:
            upload = {"upload": {"href": f"{self.hub.endpoint}/lfs/{each['oid']}"}}
            objects.append(each if each["oid"] in self.hub.blobs else {**each, "actions": upload})
        self._json({"transfer": "basic", "objects": objects})

    def lfs_put(self, oid: str) -> None:
        if hashlib.sha256(self.body).hexdigest() != oid:
            raise HubError(400, "BadRequest", "content and oid differ")
        self.hub.blobs[oid] = self.body
        self._send(200, b"", {})

    def commit(self, key: str, revision: str) -> None:
        repository = self.hub.find(key)
        files, message = dict(repository.files(revision)), ""
        for line in self.body.splitlines():
            item = json.loads(line)
            kind, value = item["key"], item["value"]
            if kind == "header":
                message = value["summary"]
            elif kind == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif kind == "lfsFile":
                if value["oid"] not in self.hub.blobs:
                    raise HubError(400, "BadRequest", f"{value['path']} was not uploaded")
                files[value["path"]] = self.hub.blobs[value["oid"]]
            else:
                del files[value["path"]]
        sha = repository.commit(files, message)
        url = f"{self.hub.endpoint}/{key.removeprefix('models/')}/commit/{sha}"
        self._json({"success": True, "commitOid": sha, "commitUrl": url})

    def make_tag(self, key: str, name: str) -> None:
        repository = self.hub.find(key)
        tag = json.loads(self.body)["tag"]
        if tag in repository.refs:
            raise HubError(409, "TagExists", "Tag reference exists already")
        repository.refs[tag] = repository.sha(name)
        repository.tags.add(tag)
        self._json({})

    def delete_tag(self, key: str, name: str) -> None:
        repository = self.hub.find(key)
        if name not in repository.tags:
            raise HubError(404, "RevisionNotFound", f"no tag {name}")
        repository.tags.remove(name)
        del repository.refs[name]
        self._json({})

    # Reading

    def whoami(self) -> None:
        self._json({"type": "user", "name": "me", "orgs": []})

    def info(self, key: str, revision: str | None = None) -> None:
        repository = self.hub.find(key)
        sha = repository.sha(revision or "main")
        named = {"id": key.split("/", 1)[1], "sha": sha, "private": repository.is_private}
        siblings = [{"rfilename": path} for path in repository.commits[sha]]
        self._json({**named, "siblings": siblings, "tags": [], "downloads": 0, "likes": 0})

    def refs(self, key: str) -> None:
        repository = self.hub.find(key)
        named = {
            kind: [
                {"name": name, "ref": f"refs/{kind}/{name}", "targetCommit": sha}
                for name, sha in repository.refs.items()
                if (name in repository.tags) == (kind == "tags")
            ]
            for kind in ("heads", "tags")
        }
        self._json({"branches": named["heads"], "tags": named["tags"], "converts": []})

    def tree(self, key: str, revision: str, folder: str = "") -> None:
        files = self.hub.find(key).files(revision)
        found = [described(path, content) for path, content in files.items() if path.startswith(folder or "")]
        self._json(found)

    def resolve(self, key: str, revision: str, path: str) -> None:
        repository = self.hub.find(key if key.startswith("datasets/") else f"models/{key}")
        sha = repository.sha(revision)
        content = repository.commits[sha].get(path)
        if content is None:
            self._send(404, b"", {"X-Error-Code": "EntryNotFound", "X-Repo-Commit": sha})
            return
        self._send(200, content, {"ETag": f'"{git_oid(content)}"', "X-Repo-Commit": sha})


_KEY = r"(?P<key>(?:models|datasets)/[^/]+/[^/]+)"
_URL = r"(?P<key>(?:datasets/)?[^/]+/[^/]+)"
ROUTES = (
    ("POST", "/api/repos/create", "create"),
    ("POST", "/api/validate-yaml", "validate"),
    ("POST", rf"/api/{_KEY}/preupload/(?P<revision>.+)", "preupload"),
    ("POST", rf"/{_URL}\.git/info/lfs/objects/batch", "lfs_batch"),
    ("PUT", r"/lfs/(?P<oid>\w+)", "lfs_put"),
    ("POST", rf"/api/{_KEY}/commit/(?P<revision>.+)", "commit"),
    ("POST", rf"/api/{_KEY}/tag/(?P<name>.+)", "make_tag"),
    ("DELETE", rf"/api/{_KEY}/tag/(?P<name>.+)", "delete_tag"),
    ("GET", "/api/whoami-v2", "whoami"),
    ("GET", rf"/api/{_KEY}", "info"),
    ("GET", rf"/api/{_KEY}/revision/(?P<revision>.+)", "info"),
    ("GET", rf"/api/{_KEY}/refs", "refs"),
    ("GET", rf"/api/{_KEY}/tree/(?P<revision>[^/]+)(?:/(?P<folder>.+))?", "tree"),
    ("GET", rf"/{_URL}/resolve/(?P<revision>[^/]+)/(?P<path>.+)", "resolve"),
)
