"""A study in a database that several machines share: servers of its own, on loopback."""

import json
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy
from test_explore import prepared, shared

from twin import explore
from twin.complaint import DesignError


@dataclass(frozen=True)
class Server:
    """A database server: its commands, where Debian keeps them, and how it is set up, started and stopped."""

    name: str
    package: str
    url: str
    commands: tuple[str, ...]
    folders: str
    prepare: Callable[[Path, tuple[str, ...], dict[str, Any]], None]
    start: Callable[[Path, str, int], list[str]]
    stop: signal.Signals

    def find(self) -> tuple[str, ...]:
        """Its commands; the test is skipped where they are not installed."""
        found = [
            shutil.which(name) or next(map(str, sorted(Path("/usr").glob(f"{self.folders}/{name}"))), None)
            for name in self.commands
        ]
        if None in found:
            pytest.skip(f"{self.name}'s server is not installed (Debian: apt-get install {self.package})")
        return tuple(map(str, found))


def init_postgres(home: Path, commands: tuple[str, ...], options: dict[str, Any]) -> None:
    command = [commands[0], "-D", home / "data", "-U", "designer", "-A", "trust"]
    subprocess.run(command, check=True, **options)


def init_maria(home: Path, commands: tuple[str, ...], options: dict[str, Any]) -> None:
    command = [
        commands[0],
        "--no-defaults",
        f"--datadir={home / 'data'}",
        "--auth-root-authentication-method=normal",
    ]
    subprocess.run(command, check=True, **options)
    (home / "designer.sql").write_text(
        "create database studies;\n"
        "create user 'designer'@'localhost' identified by 'secret';\n"
        "grant all on studies.* to 'designer'@'localhost';\n"
    )


SERVERS = (
    Server(
        "PostgreSQL",
        "postgresql",
        "postgresql://designer:secret@127.0.0.1:{port}/postgres",
        ("initdb", "postgres"),
        "lib/postgresql/*/bin",
        init_postgres,
        lambda home, server, port: [
            server,
            "-D",
            str(home / "data"),
            "-h",
            "127.0.0.1",
            "-p",
            str(port),
            "-k",
            "",
            "-F",
        ],
        signal.SIGINT,  # without waiting for its clients to go
    ),
    Server(
        "MariaDB",
        "mariadb-server",
        "mysql+pymysql://designer:secret@127.0.0.1:{port}/studies",
        ("mariadb-install-db", "mariadbd"),
        "sbin",
        init_maria,
        lambda home, server, port: [
            server,
            "--no-defaults",
            f"--datadir={home / 'data'}",
            f"--socket={home / 'socket'}",
            f"--init-file={home / 'designer.sql'}",
            "--bind-address=127.0.0.1",
            f"--port={port}",
        ],
        signal.SIGTERM,
    ),
)


@pytest.fixture(scope="module", params=SERVERS, ids=lambda server: server.name)
def database(request: pytest.FixtureRequest) -> Iterator[str]:
    """URL of an empty database. Servers refuse root, so root starts them as nobody."""
    server: Server = request.param
    commands = server.find()
    root = os.geteuid() == 0
    who = {"user": "nobody", "group": "nogroup", "extra_groups": []} if root else {}
    home = Path("/tmp") / f"twin-server-{os.getpid()}"  # a short path that nobody may enter
    home.mkdir(mode=0o700)
    try:
        if root:
            shutil.chown(home, "nobody", "nogroup")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        options = {"cwd": home, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, **who}
        server.prepare(home, commands, options)
        with subprocess.Popen(server.start(home, commands[-1], port), **options) as running:
            try:
                yield server.url.format(port=port)
            finally:
                running.send_signal(server.stop)
    finally:
        shutil.rmtree(home)


def opened_soon(url: str) -> None:
    """Wait until the server answers."""
    engine = sqlalchemy.create_engine(url)
    for _ in range(100):
        try:
            engine.connect().close()
            engine.dispose()
            return
        except sqlalchemy.exc.OperationalError:
            time.sleep(0.1)
    raise TimeoutError(url)


def test_processes_share_a_study_on_a_server(tmp_path: Path, database: str) -> None:
    opened_soon(database)
    found = prepared(tmp_path, storage=database)
    shared(found)
    assert not (found.folder / explore.DATABASE).exists()
    assert json.loads((found.folder / explore.HEAD).read_text())["storage"] == database


def test_a_password_is_not_told(tmp_path: Path) -> None:
    with pytest.raises(DesignError, match="--storage") as caught:
        prepared(tmp_path, storage="postgresql://designer:secret@127.0.0.1:1/none")
    assert "secret" not in str(caught.value) and "\n" not in str(caught.value)
