"""A study in a database that several machines share: a PostgreSQL server of its own, on loopback."""

import json
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from test_explore import prepared, shared

from twin import explore
from twin.complaint import DesignError


def tool(name: str) -> str | None:
    """A command of PostgreSQL: Debian keeps them off the PATH."""
    found = shutil.which(name)
    return found or next(map(str, sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))), None)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """URL of an empty database. The server refuses root, so root starts it as nobody."""
    initdb, server = tool("initdb"), tool("postgres")
    if initdb is None or server is None:
        pytest.skip("PostgreSQL's server is not installed (Debian: apt-get install postgresql)")
    root = os.geteuid() == 0
    who = {"user": "nobody", "group": "nogroup", "extra_groups": []} if root else {}
    home = Path("/tmp") / f"twin-postgres-{os.getpid()}"  # a short path that nobody may enter
    home.mkdir(mode=0o700)
    try:
        if root:
            shutil.chown(home, "nobody", "nogroup")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        options = {"cwd": home, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, **who}
        subprocess.run([initdb, "-D", home / "data", "-U", "designer", "-A", "trust"], check=True, **options)
        command = [server, "-D", home / "data", "-h", "127.0.0.1", "-p", str(port), "-k", "", "-F"]
        with subprocess.Popen(command, **options) as running:
            try:
                yield f"postgresql://designer:secret@127.0.0.1:{port}/postgres"
            finally:
                running.send_signal(signal.SIGINT)  # without waiting for its clients to go
    finally:
        shutil.rmtree(home)


def opened_soon(url: str) -> None:
    """Wait until the server answers."""
    for _ in range(100):
        try:
            psycopg.connect(url).close()
            return
        except psycopg.OperationalError:
            time.sleep(0.1)
    raise TimeoutError(url)


def test_processes_share_a_study_in_postgresql(tmp_path: Path, database: str) -> None:
    opened_soon(database)
    found = prepared(tmp_path, storage=database)
    shared(found)
    assert not (found.folder / explore.DATABASE).exists()
    assert json.loads((found.folder / explore.HEAD).read_text())["storage"] == database


def test_a_password_is_not_told(tmp_path: Path) -> None:
    with pytest.raises(DesignError, match="--storage") as caught:
        prepared(tmp_path, storage="postgresql://designer:secret@127.0.0.1:1/none")
    assert "secret" not in str(caught.value) and "\n" not in str(caught.value)
