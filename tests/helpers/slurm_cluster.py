"""A SLURM cluster of this machine alone, on loopback addresses, with files of its own."""

import contextlib
import getpass
import os
import secrets
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel", "scontrol")
PATH = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])
MISSING = [name for name in PROGRAMS if shutil.which(name, path=PATH) is None]
"""Programs that this machine lacks (on Debian: apt-get install slurm-wlm munge)."""

CONFIGURATION = """
ClusterName=trial
SlurmctldHost=localhost
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=batch_sched_delay=0,sched_min_interval=0
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
KillWait=20
MailProg=/bin/true
NodeName=localhost NodeAddr=127.0.0.1 CPUs=2 RealMemory=4000 State=UNKNOWN
PartitionName=trial Nodes=localhost Default=YES DefaultTime=20 MaxTime=60 DefMemPerCPU=500 State=UP
"""


@contextlib.contextmanager
def cluster() -> Iterator[Path]:
    """Runs the daemons; gives the configuration, which SLURM's commands find by SLURM_CONF."""
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # short: the path of a socket is limited
    folder.chmod(0o711)  # munged wants that all users reach its socket
    (folder / "state").mkdir(mode=0o700)
    (folder / "spool").mkdir(mode=0o755)
    key = folder / "munge.key"
    key.write_bytes(secrets.token_bytes(128))
    key.chmod(0o400)
    configuration = folder / "slurm.conf"
    values = {"ports": _ports(), "user": getpass.getuser(), "folder": folder}
    configuration.write_text(CONFIGURATION.format(**values))
    names = {"key-file": key, "socket": folder / "munge.socket", "pid-file": folder / "munge.pid"}
    names |= {"log-file": folder / "munge.log", "seed-file": folder / "munge.seed"}
    munged = ["munged", "--foreground", *(f"--{name}={path}" for name, path in names.items())]
    commands = [munged, ["slurmctld", "-D"], ["slurmd", "-D", "-N", "localhost"]]
    environment = {**os.environ, "SLURM_CONF": str(configuration), "PATH": PATH}
    with contextlib.ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        for command in commands:
            log = stack.enter_context((folder / f"{command[0]}.out").open("w"))
            daemon = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            stack.callback(_end, daemon)
            time.sleep(0.5)
        _wait(environment, folder)
        stack.callback(_empty, environment)
        yield configuration


def _ports() -> list[int]:
    """Two ports that are free."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(2)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def _end(daemon: subprocess.Popen) -> None:
    daemon.terminate()
    try:
        daemon.wait(20)
    except subprocess.TimeoutExpired:
        daemon.kill()
        daemon.wait()


def _wait(environment: dict[str, str], folder: Path) -> None:
    """Waits until the node is ready; fails with what the daemons said."""
    for _ in range(30):
        asked = ["sinfo", "--noheader", "--format=%T"]
        found = subprocess.run(asked, env=environment, capture_output=True, text=True)
        if found.stdout.strip() == "idle":
            return
        time.sleep(0.5)
    raise RuntimeError("\n".join(p.read_text() for p in folder.glob("*.out")))


def _empty(environment: dict[str, str]) -> None:
    """Ends every job, so that no process outlives the cluster."""
    subprocess.run(["scancel", "--user", getpass.getuser()], env=environment)
    for _ in range(60):
        asked = ["squeue", "--noheader"]
        if not subprocess.run(asked, env=environment, capture_output=True, text=True).stdout:
            return
        time.sleep(0.5)
