#!/bin/sh
# A mission on the nodes of a SLURM job: sbatch --nodes=4 slurm.sh MISSION CERTIFICATES
#
# The first node runs scheduler and command, every node the workers of its cores. CERTIFICATES is a
# folder with ca.pem, own.pem and own.key, readable by the owner alone. Both folders have the same
# path on all nodes.
#SBATCH --job-name=syntopic
#SBATCH --ntasks-per-node=1
#SBATCH --exclusive
#SBATCH --time=04:00:00
set -eu
mission=$1
certificates=$2
port=8786
host=$(hostname --fqdn)
tls="--tls-ca $certificates/ca.pem --tls-certificate $certificates/own.pem --tls-key $certificates/own.key"

export DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED=False DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL=1s
dask scheduler --protocol tls --host "$host" --port "$port" --dashboard-address 127.0.0.1:8787 \
    --tls-ca-file "$certificates/ca.pem" --tls-cert "$certificates/own.pem" \
    --tls-key "$certificates/own.key" &
scheduler=$!
workers=
trap 'kill $scheduler $workers 2>/dev/null' EXIT
# shellcheck disable=SC2086  # the options are words
srun syntopic worker "tls://$host:$port" $tls &
workers=$!
# shellcheck disable=SC2086
syntopic process "$mission" --scheduler "tls://$host:$port" $tls
