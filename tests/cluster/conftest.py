"""A Slurm of one node and a Ray of two, on this machine, for as long as the tests take; skipped where they are not."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from clusters import STEPS, Engine, await_, free_port, needs

SLURM_CONF = """
ClusterName=srlrace
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
# Requeued jobs are held for as long as credentials live.
AuthInfo=socket={place}/munge/socket,cred_expire=5
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={place}/state
SlurmdSpoolDir={place}/spool
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd.pid
SlurmctldLogFile={place}/slurmctld.log
SlurmdLogFile={place}/slurmd.log
# Processes are followed by their parents: containers seldom may write to control groups.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
MpiDefault=none
SwitchType=switch/none
ReturnToService=2
KillWait=20
MailProg=/bin/true
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory=6000 State=UNKNOWN
# Jobs of the last partition take the place of those of the others: at once, or after a time of grace.
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
PartitionName=debug Nodes={host} Default=YES MaxTime=60 State=UP
PartitionName=graced Nodes={host} MaxTime=60 State=UP GraceTime=120
PartitionName=urgent Nodes={host} MaxTime=60 State=UP PriorityTier=2 PreemptMode=OFF
"""


@pytest.fixture(scope="session")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    """A Slurm of this machine alone, with daemons of our own."""
    needs(("slurmctld", "slurmd", "munged", "sbatch"), ("submitit", "hydra_plugins.hydra_submitit_launcher"))
    if os.geteuid() != 0:
        pytest.skip("slurmd starts jobs as their users: it has to be root")
    place = tmp_path_factory.mktemp("slurm")
    place.chmod(0o755)  # munged refuses a folder that others may write to, and one that they may not see
    for name in ("state", "spool", "munge"):
        (place / name).mkdir(mode=0o755)
    for parent in place.parents[:2]:
        parent.chmod(parent.stat().st_mode | 0o055)
    (place / "munge.key").write_bytes(os.urandom(1024))
    (place / "munge.key").chmod(0o400)
    host = socket.gethostname().partition(".")[0]
    conf = SLURM_CONF.format(host=host, place=place, ports=(free_port(), free_port()), cores=os.cpu_count())
    (place / "slurm.conf").write_text(conf)
    # slurmd 22.05 insists on a plugin for control groups, though nothing here uses them; the old one does not mind.
    (place / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
    engine = Engine({"SLURM_CONF": str(place / "slurm.conf")})
    munge = place / "munge"
    engine.start("munged", "--foreground", "--force", f"--key-file={place}/munge.key", f"--socket={munge}/socket",
                 f"--pid-file={munge}/pid", f"--log-file={munge}/log", f"--seed-file={munge}/seed")  # fmt: skip
    await_((munge / "socket").exists, 30)
    engine.start("slurmctld", "-D")
    engine.start("slurmd", "-D")
    try:
        await_(lambda: "idle" in engine.run("sinfo", check=False), 60)
        yield engine
    finally:
        engine.run("scancel", "--user=root", check=False)  # what a failed test has left
        with suppress(AssertionError):
            await_(lambda: not engine.run("squeue", "--noheader", check=False), 60)
        for process in reversed(engine.processes):
            process.terminate()
            process.wait(30)


@pytest.fixture(scope="session")
def ray_cluster() -> Iterator[Engine]:
    """A Ray of two nodes with one core each, both on this machine."""
    needs(("ray",), ("ray",))
    port = free_port()
    # Ray's workers are polite to everything else by default, which on a busy machine means that they stand still.
    engine = Engine({"RAY_ADDRESS": f"127.0.0.1:{port}", "RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"})
    common = ("--num-cpus=1", "--block", "--disable-usage-stats", "--object-store-memory=80000000",
              "--node-ip-address=127.0.0.1")  # fmt: skip
    engine.start("ray", "start", "--head", f"--port={port}", "--include-dashboard=false", *common)
    await_(lambda: "1.0 CPU" in engine.run("ray", "status", check=False), 120)
    engine.start("ray", "start", f"--address=127.0.0.1:{port}", *common)
    await_(lambda: "2.0 CPU" in engine.run("ray", "status", check=False), 120)
    try:
        yield engine
    finally:
        for process in reversed(engine.processes):
            process.terminate()
            process.wait(60)


@pytest.fixture(scope="session")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs as they are without any cluster, interruption or company."""
    needs((), ())
    folder = tmp_path_factory.mktemp("reference") / "runs"
    Engine({}).srlrace("sweep", "smoke", "--seeds", "3", "--steps", str(STEPS), "--runs", str(folder))
    return folder
