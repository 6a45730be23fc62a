"""Kill -9 of workers, schedulers and whole commands at random moments: the table is the one made in one go."""

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

pytest.importorskip("distributed")

import kill_child

from jaxbiped import batch
from jaxbiped.batch import store, workers

CHILD = Path(__file__).with_name("kill_child.py")
LIMIT_S = 300.0
"""Nothing here takes that long, unless it hangs."""
KILLS = 4
"""In one folder."""
ROUNDS = {
    "one worker": (1, ("command",)),
    "two workers": (2, ("worker", "command")),
    "three workers": (3, ("worker", "command")),
    "scheduler": (2, ("scheduler", "worker", "command", "scheduler")),
    "scheduler again": (2, ("scheduler", "worker", "scheduler", "command")),
}


class Command:
    """A child process in a process group of its own, as a shell starts it."""

    def __init__(self, *arguments: str):
        self.process = subprocess.Popen(
            [sys.executable, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": str(Path(store.__file__).parents[2])},
        )

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def family(self) -> list[psutil.Process]:
        """The process and all it started."""
        try:
            parent = psutil.Process(self.process.pid)
            return [parent, *parent.children(recursive=True)]
        except psutil.NoSuchProcess:
            return []

    def signal(self, number: int = signal.SIGKILL) -> None:
        """To the whole process group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def end(self, timeout: float = LIMIT_S) -> tuple[int, str, str]:
        """Wait for the end; exit status, output, errors."""
        try:
            out, err = self.process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.stop()
            raise
        return self.process.returncode, out, err

    def stop(self) -> None:
        """Kill all, and read what is left in the pipes."""
        self.signal()
        self.process.communicate()


class Cluster:
    """A scheduler and workers, each started anew if it is gone, as a service manager does."""

    def __init__(self, hosts: tuple[str, ...] = ("127.0.0.1", "127.0.0.1")):
        self.port, self.hosts = free_port(), hosts
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.scheduler: Command | None = None
        self.workers: list[Command | None] = [None] * len(hosts)

    def __enter__(self) -> "Cluster":
        self.heal()
        return self

    def __exit__(self, *_: object) -> None:
        for each in (*self.workers, self.scheduler):
            if each is not None:
                each.stop()

    def heal(self) -> None:
        """Start what is not running."""
        if self.scheduler is None or not self.scheduler.running:
            module, port = "distributed.cli.dask_scheduler", str(self.port)
            self.scheduler = renewed(
                self.scheduler, "-m", module, "--host", "127.0.0.1", "--port", port, "--no-dashboard"
            )
            wait_until(lambda: listens(self.port))
        for i, host in enumerate(self.hosts):
            worker = self.workers[i]
            if worker is None or not worker.running:
                module = "distributed.cli.dask_worker"
                self.workers[i] = renewed(
                    worker, "-m", module, self.address, "--host", host, "--nthreads", "1", "--no-dashboard"
                )


def renewed(old: Command | None, *arguments: str) -> Command:
    if old is not None:
        old.stop()
    return Command(*arguments)


def free_port() -> int:
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))
        return door.getsockname()[1]


def listens(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex(("127.0.0.1", port)) == 0


def wait_until(condition: Callable[[], bool], timeout: float = LIMIT_S) -> None:
    until = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < until, "it never came"
        time.sleep(0.01)


def run_child(folder: Path, count: int, scheduler: str | None = None) -> Command:
    return Command(str(CHILD), str(folder), str(count), *([scheduler] if scheduler else []))


def parts(folder: Path) -> dict[str, bytes]:
    """Finished parts by name; a name that starts with a point is one that was being written."""
    return {
        part.name: part.read_bytes()
        for part in (folder / store.PARTS).glob("*.parquet")
        if part.name[0] != "."
    }


def worker_processes(command: Command) -> list[psutil.Process]:
    """Those below a command that walk."""
    found = []
    for process in command.family():
        try:
            if "spawn_main" in " ".join(process.cmdline()):
                found.append(process)
        except psutil.NoSuchProcess:
            pass
    return found


@pytest.fixture(scope="module")
def in_one_go(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that nobody disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    assert run_child(folder, 1).end() == (0, "", "")
    return folder


def random_moment(dice: random.Random, folder: Path, command: Command) -> None:
    """Wait: for any time since the start, or while parts are being written; shorter if the command ends."""
    start, before = time.monotonic(), len(parts(folder))
    delay = dice.choice([dice.uniform(0.0, 20.0), dice.uniform(0.0, 0.2)])
    if delay < 0.2:
        wait_until(lambda: len(parts(folder)) > before or not command.running)
        start = time.monotonic()
    wait_until(lambda: time.monotonic() > start + delay or not command.running)


def strike(kind: str, dice: random.Random, command: Command, cluster: Cluster | None) -> bool:
    """Kill; whether there was something to be killed."""
    if not command.running:
        return False
    if kind == "command":
        command.signal()
        return True
    if kind == "scheduler":
        assert cluster is not None and cluster.scheduler is not None
        cluster.scheduler.signal()
        return True
    at_work = [command] if cluster is None else [worker for worker in cluster.workers if worker is not None]
    found = [process for each in at_work for process in worker_processes(each)]
    if not found:
        return False
    dice.choice(found).kill()
    return True


@pytest.mark.slow
@pytest.mark.parametrize("name", ROUNDS)
def test_kills_at_random_moments_leave_the_table_as_it_is(in_one_go: Path, tmp_path: Path, name: str) -> None:
    count, kinds = ROUNDS[name]
    seed = int(os.environ.get("JAXBIPED_KILL_SEED", time.time_ns() % 10**6))
    print(f"\n{name}: JAXBIPED_KILL_SEED={seed}")
    dice, whole = random.Random(f"{seed} {name}"), parts(in_one_go)
    if "scheduler" in kinds:
        with Cluster() as cluster:
            survive(dice, tmp_path, whole, count, kinds, cluster)
    else:
        survive(dice, tmp_path, whole, count, kinds, None)
    assert (tmp_path / store.TABLE).read_bytes() == (in_one_go / store.TABLE).read_bytes()
    assert not list(tmp_path.rglob(".*.parquet.*")) or "command" in kinds


def survive(
    dice: random.Random,
    folder: Path,
    whole: dict[str, bytes],
    count: int,
    kinds: tuple[str, ...],
    cluster: Cluster | None,
) -> None:
    """Strike KILLS times, start again what has ended, and let it come to its end."""
    address, struck, began = cluster and cluster.address, 0, time.monotonic()
    command = run_child(folder, count, address)
    try:
        while struck < KILLS or command.running or not (folder / store.TABLE).exists():
            if cluster is not None:
                cluster.heal()  # workers may end long after their scheduler did
            if not command.running:
                command = again(command, dice, folder, struck < KILLS, count, address)
            if struck == KILLS:
                wait_until(lambda one=command: not one.running)
                continue
            random_moment(dice, folder, command)
            kind = kinds[struck % len(kinds)]
            if strike(kind, dice, command, cluster):
                struck += 1
                print(
                    f"  {time.monotonic() - began:6.1f} s: kill {struck}, {kind}, parts {len(parts(folder))}"
                )
                if kind != "worker":
                    wait_until(lambda one=command: not one.running)
                if cluster is not None:
                    cluster.heal()
                assert all(whole[part] == content for part, content in parts(folder).items())
    finally:
        command.stop()


def again(
    old: Command, dice: random.Random, folder: Path, more: bool, count: int, address: str | None
) -> Command:
    """Start the command again; some parts are dropped first if it was done before all was struck."""
    status, out, err = old.end()
    lost = status == 3 and err.startswith("WorkersError: ") and err.count("\n") == 1
    assert status in (0, -signal.SIGKILL) or lost, (status, err)
    assert out == "" and (err == "" or lost or status == -signal.SIGKILL), (status, err)
    if more and (folder / store.TABLE).exists():
        (folder / store.TABLE).unlink()
        for part in dice.sample(sorted((folder / store.PARTS).glob("*.parquet")), 6):
            part.unlink()
    return run_child(folder, count, address)


@pytest.mark.slow
def test_workers_on_two_addresses_give_the_same_table_to_two_commands_at_once(
    in_one_go: Path, tmp_path: Path
) -> None:
    with Cluster(("127.0.0.1", "127.0.0.2")) as cluster:
        commands = [run_child(tmp_path / name, 2, cluster.address) for name in ("a", "b")]
        try:
            assert [command.end() for command in commands] == [(0, "", "")] * 2
        finally:
            for command in commands:
                command.stop()
    for name in ("a", "b"):
        assert (tmp_path / name / store.TABLE).read_bytes() == (in_one_go / store.TABLE).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("whom", ["group", "command"])
def test_interrupt_is_prompt_keeps_parts_and_leaves_no_process(
    in_one_go: Path, tmp_path: Path, whom: str
) -> None:
    command = run_child(tmp_path, 2)
    try:
        wait_until(lambda: bool(parts(tmp_path)) or not command.running)
        kept, children = parts(tmp_path), command.family()[1:]
        if whom == "group":
            command.signal(signal.SIGINT)
        else:
            command.process.send_signal(signal.SIGINT)
        status, out, err = command.end(timeout=30.0)
    finally:
        command.stop()
    assert status == -signal.SIGINT and out == "" and err.count("Traceback") == 1, err
    assert children and psutil.wait_procs(children, timeout=5.0)[1] == []
    assert kept.items() <= parts(tmp_path).items() <= parts(in_one_go).items()


BAD = ["", "elsewhere", "127.0.0.1:8786", "http://127.0.0.1:8786", "tcp://127.0.0.1", "tcp://127.0.0.1:65536"]


@pytest.mark.parametrize("address", BAD)
def test_malformed_address_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match=r"scheduler: got '.*', allowed: an address like tcp://HOST:PORT"):
        workers.require_address(address)


@pytest.mark.parametrize("listening", [False, True])
def test_scheduler_that_never_answers_is_a_clear_error(
    monkeypatch: pytest.MonkeyPatch, listening: bool
) -> None:
    monkeypatch.setattr(workers, "CONNECT_S", 1)
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))
        if listening:  # and says nothing
            door.listen()
        address = f"tcp://127.0.0.1:{door.getsockname()[1]}"
        with pytest.raises(batch.WorkersError, match=f"scheduler '{address}' cannot be reached"):
            one = kill_child.experiment()
            next(workers.on_dask(one, one.chunks, 2, address, lambda *_: None))


def test_scheduler_without_workers_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "PATIENCE_S", 1.0)
    one = kill_child.experiment()
    with (
        Cluster(()) as cluster,
        pytest.raises(batch.WorkersError, match="got none in 1 s, allowed: at least"),
    ):
        next(workers.on_dask(one, one.chunks, 2, cluster.address, lambda *_: None))
