"""Slurm: job steps in one allocation, with a munged, slurmctld and slurmd of its own; needs root.

Steps are Slurm's way to run many short tasks: an array job of 300 tasks takes about 100 s. The
daemons have their key, sockets and state in a temporary directory, and end with the measurement.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.peers import measuring, work

_PATIENCE_S = 60.0
_PERIOD_S = 0.05

_COMMANDS: Mapping[Callable[..., Any], Callable[[Any], Sequence[str]]] = {
    work.stamp: lambda _: work.STAMP,
    work.succeed: lambda _: ("true",),
    work.sleep: lambda seconds: ("sleep", str(seconds)),
    work.hold: lambda arguments: work.holder(*arguments),
}

#: One node with as many CPUs as wanted, and nothing is accounted.
_CONFIG = """\
ClusterName=rosrm_peers
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={master}
SlurmdPort={slave}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
NodeName={host} NodeAddr=127.0.0.1 CPUs={slots} State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


class Steps:
    """Job steps of one allocation; each waits until a CPU of it is free."""

    def __init__(self, pool: ThreadPoolExecutor, job: str) -> None:
        self._pool = pool
        self._srun = ("srun", f"--jobid={job}", "--exact", "--ntasks=1", "--quiet")

    def start(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Future[str]]:
        command = _COMMANDS[function]
        return [self._pool.submit(_tool, *self._srun, *command(one)) for one in items]

    def results(self, handle: list[Future[str]]) -> list[Any]:
        return [int(said) if (said := one.result()) else None for one in handle]


@contextmanager
def opened(at_once: int) -> Iterator[Steps]:
    with ExitStack() as parts:
        folder = Path(parts.enter_context(tempfile.TemporaryDirectory(prefix="rosrm-slurm-")))
        folder.chmod(0o755)  # munged refuses a socket that other users do not reach
        key, config = folder / "munge.key", folder / "slurm.conf"
        key.touch(0o600)
        key.write_bytes(os.urandom(128))
        config.write_text(_config(folder, at_once), encoding="ascii")
        os.environ["SLURM_CONF"] = str(config)
        files = ("socket", "key-file", "pid-file", "log-file", "seed-file")
        paths = [f"--{name}={folder}/munge.{name.partition('-')[0]}" for name in files]
        parts.enter_context(_daemon("munged", "--foreground", "--force", *paths))
        _await((folder / "munge.socket").exists, "munged")
        for name in ("slurmctld", "slurmd"):
            parts.enter_context(_daemon(name, "-D", "-f", str(config)))
        _await(_is_idle, "a node that takes jobs")
        _tool("salloc", "--no-shell", f"--ntasks={at_once}", "--job-name=peers")
        job = _tool("squeue", "--noheader", "--format=%i")
        yield Steps(parts.enter_context(ThreadPoolExecutor(at_once)), job)


def _config(folder: Path, slots: int) -> str:
    with socket.socket() as one, socket.socket() as other:
        for listener in (one, other):
            listener.bind(("127.0.0.1", 0))
        master, slave = one.getsockname()[1], other.getsockname()[1]
    host = socket.gethostname().partition(".")[0]
    return _CONFIG.format(folder=folder, host=host, slots=slots, master=master, slave=slave)


@contextmanager
def _daemon(name: str, *words: str) -> Iterator[None]:
    with subprocess.Popen(
        [name, *words], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        try:
            yield
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE_S)
            process.kill()


def _is_idle() -> bool:
    with contextlib.suppress(subprocess.CalledProcessError):
        return _tool("sinfo", "--noheader", "--format=%T") == "idle"
    return False


def _await(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while not condition():
        if time.monotonic() >= deadline:
            raise TimeoutError(f"waited {_PATIENCE_S:g} s for {what}")
        time.sleep(_PERIOD_S)


def _tool(*words: str) -> str:
    done = subprocess.run(
        words, check=True, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    return done.stdout.strip()


if __name__ == "__main__":
    measuring.main(measuring.of_executor(opened))
