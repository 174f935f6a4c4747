"""A SLURM of one node on this machine, in namespaces of its own, and one job on it.

    python -m tests.support.slurm_machine FOLDER EXPOSURES

It runs as root, with Debian's packages slurmctld, slurmd, slurm-client and munge; `--install` puts
them into an overlay of this machine's root in FOLDER, which leaves the machine as it is. The job is
`systemd/cluster/slurm.sh` with a mission of so many small exposures; its products are checked. All
processes end with the command.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

from daemon.mission.store import product_manifests
from tests.daemon.diverging_camera import ROOT, flown_mission
from tests.daemon.postflight.batch.test_dask_executor import authority

PACKAGES = ("slurmctld", "slurmd", "slurm-client", "munge")
INSIDE = """
set -e
root={folder}/root
mount -t overlay overlay -o lowerdir=/,upperdir={folder}/upper,workdir={folder}/work $root
mount -t proc proc $root/proc
mount --rbind /dev $root/dev
mount --rbind /sys $root/sys
mount --bind {folder}/common $root/{folder}/common
if [ -n "{install}" ]; then
    printf '#!/bin/sh\\nexit 101\\n' > $root/usr/sbin/policy-rc.d
    chmod +x $root/usr/sbin/policy-rc.d
    chroot $root env DEBIAN_FRONTEND=noninteractive apt-get -q update
    chroot $root env DEBIAN_FRONTEND=noninteractive \\
        apt-get -q install -y --no-install-recommends {packages}
fi
mount -t tmpfs tmpfs $root/run
mkdir -p $root/run/munge $root/var/spool/slurmd $root/var/spool/slurmctld $root/etc/slurm
chroot $root chown slurm /var/spool/slurmctld
chroot $root chown -R munge: /run/munge /var/log/munge /var/lib/munge /etc/munge
cp {folder}/common/slurm.conf $root/etc/slurm/slurm.conf
chroot $root runuser -u munge -- /usr/sbin/munged --force
chroot $root /usr/sbin/slurmctld
chroot $root /usr/sbin/slurmd
for attempt in $(seq 60); do
    chroot $root sinfo --noheader --format %T | grep -q idle && break
    sleep 1
done
chroot $root sinfo
cd $root
exec chroot $root sh {folder}/common/submit.sh
"""
CONFIGURATION = """
ClusterName=one
SlurmctldHost={host}
SlurmUser=slurm
AuthType=auth/munge
StateSaveLocation=/var/spool/slurmctld
SlurmdSpoolDir=/var/spool/slurmd
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SlurmctldLogFile={folder}/common/slurmctld.txt
SlurmdLogFile={folder}/common/slurmd.txt
NodeName={host} CPUs={cores} RealMemory={memory_mb} State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.support.slurm_machine", description=__doc__
    )
    parser.add_argument("folder", type=Path, help="new folder")
    parser.add_argument("exposures", type=int)
    parser.add_argument("--install", action="store_true", help="packages into the overlay")
    options = parser.parse_args()
    if os.geteuid():
        parser.error("run it as root: it mounts and changes root")
    folder = options.folder.resolve()
    for name in ("upper", "work", "root", "common"):
        (folder / name).mkdir(parents=True)
    (folder / "upper" / str(folder / "common")[1:]).mkdir(parents=True)
    common = folder / "common"
    mission = flown_mission(common / "flown", range(1, options.exposures + 1))
    certificates = common / "certificates"
    certificates.mkdir()
    for path in authority(common / "authority", "slurm"):
        shutil.copy2(path, certificates / path.name)
    (certificates / "own.key").chmod(0o600)
    memory_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 9 // 10 >> 20
    (common / "slurm.conf").write_text(
        CONFIGURATION.format(
            host=platform.node(), folder=folder, cores=os.cpu_count(), memory_mb=memory_mb
        )
    )
    (common / "syntopic").write_text(f'#!/bin/sh\nexec {sys.executable} -m daemon "$@"\n')
    (common / "syntopic").chmod(0o755)
    binaries = f"{common}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    (common / "submit.sh").write_text(
        f"cd {ROOT}\nexport PATH={binaries} PYTHONPATH={ROOT}\n"
        f"exec sbatch --wait --nodes=1 --output={common}/job.txt systemd/cluster/slurm.sh "
        f"{mission.path} {certificates}\n"
    )
    inside = INSIDE.format(
        folder=folder, packages=" ".join(PACKAGES), install="yes" if options.install else ""
    )
    namespaces = ["unshare", "--mount", "--pid", "--fork", "--mount-proc"]
    done = subprocess.run([*namespaces, "sh", "-c", inside], check=False)
    complete = [
        number
        for number in mission.numbers()
        for key in product_manifests.committed_keys(mission, number)
        if not product_manifests.product_problems(mission, number, key)
    ]
    print(json.dumps({"status": done.returncode, "complete": len(complete)}))
    sys.exit(0 if done.returncode == 0 and len(complete) == options.exposures else 1)


if __name__ == "__main__":
    main()
