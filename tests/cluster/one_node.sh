#!/usr/bin/env bash
# A SLURM of one node from Debian's packages, for as long as a command runs in it:
#     apt-get install slurm-wlm munge
#     tests/cluster/one_node.sh python tests/cluster/sweep_on_slurm.py
# Needs root, which the daemons of SLURM and munge start as. Everything it writes lies in one temporary folder.
set -euo pipefail
for program in slurmctld slurmd munged sbatch; do
  command -v "$program" >/dev/null || { echo "$program is missing: apt-get install slurm-wlm munge" >&2; exit 2; }
done
[ "$(id -u)" = 0 ] || { echo "a SLURM of one's own needs root" >&2; exit 2; }

folder="$(mktemp -d)"
export SLURM_CONF="$folder/slurm.conf"
socket="$folder/munge.socket"
node="$(hostname -s)"
memory="$(($(grep MemTotal /proc/meminfo | tr -dc 0-9) / 1024 - 512))"
cat >"$SLURM_CONF" <<CONF
ClusterName=one
SlurmctldHost=$node(127.0.0.1)
AuthType=auth/munge
AuthInfo=socket=$socket
CryptoType=crypto/munge
SlurmUser=root
SlurmctldPort=16817
SlurmdPort=16818
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
KillWait=5
NodeName=$node NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$memory State=UNKNOWN
PartitionName=all Nodes=$node Default=YES MaxTime=INFINITE State=UP
CONF
mkdir -p "$folder/state" "$folder/spool"
dd if=/dev/urandom of="$folder/munge.key" bs=1024 count=1 status=none
chmod 600 "$folder/munge.key"

end() {
  for name in slurmd slurmctld munged; do
    [ -f "$folder/$name.pid" ] && kill "$(cat "$folder/$name.pid")" 2>/dev/null || true
  done
  sleep 1
  rm -rf "$folder"
}
trap end EXIT
chmod 711 "$folder"
munged --force --key-file="$folder/munge.key" --socket="$socket" --pid-file="$folder/munged.pid" \
  --log-file="$folder/munged.log" --seed-file="$folder/munge.seed"
slurmctld
slurmd
for _ in $(seq 60); do
  sinfo --noheader --format %t 2>/dev/null | grep -q idle && break
  sleep 0.5
done
sinfo --noheader --format %t | grep -q idle || { cat "$folder"/*.log >&2; exit 1; }
"$@"
