"""`syntopic worker`: processes of this machine that join a cluster."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from daemon import DaemonError
from daemon.cli.batch_options import TlsCa, TlsCertificate, TlsKey
from daemon.cli.options import AsJson
from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console
from drivers.base.extras import require

HELP = """Join a dask.distributed cluster with the cores of this machine.

Each process computes one exposure at a time and declares its share of the memory. A process that is
killed, or whose scheduler is gone, is started again. Ctrl-C lets exposures in work finish.

Start the scheduler with `dask scheduler`. A cluster executes what it is sent: tls:// is required
unless the scheduler is on this machine. Missions must have the same path on all machines.

Examples: `syntopic worker tcp://127.0.0.1:8786`,
`syntopic worker tls://host:8786 --tls-ca ca.pem --tls-certificate own.pem --tls-key own.key`
"""


def worker(
    scheduler: Annotated[str, typer.Argument(help="Address, such as tcp://127.0.0.1:8786.")],
    processes: Annotated[
        int | None, typer.Option(help="Number of processes (default: by cores).", min=1)
    ] = None,
    threads: Annotated[int, typer.Option(help="Number of threads of one process.", min=1)] = 1,
    tls_ca: TlsCa = None,
    tls_certificate: TlsCertificate = None,
    tls_key: TlsKey = None,
    wait: Annotated[
        float, typer.Option(help="Time without a scheduler in seconds until the end.", min=1)
    ] = 600.0,
    as_json: AsJson = False,
) -> None:
    require("cluster")
    from daemon.postflight.batch import capacity
    from daemon.postflight.batch.cluster_address import certificate_problem, cluster_address
    from daemon.postflight.batch.dask_worker import run_workers

    address = cluster_address(scheduler, tls_ca, tls_certificate, tls_key)
    if problem := certificate_problem(address):
        raise DaemonError(problem)
    count = processes or max(1, capacity.usable_cores() // threads)
    share = int(capacity.available_memory_nbytes() * capacity.MEMORY_SHARE / count)
    if share < capacity.PROCESS_NBYTES:
        raise ConfigurationError(
            [
                f"--processes {count} leaves {share / 1e9:.2f} GB for each; "
                f"{capacity.PROCESS_NBYTES / 1e9:.1f} GB are needed. Give fewer"
            ]
        )
    console = Console(stderr=True, soft_wrap=True)
    console.print(f"{count} workers join {scheduler}, {share / 1e9:.1f} GB each", highlight=False)
    if as_json:
        content = {"scheduler": scheduler, "processes": count, "memory_nbytes": share}
        typer.echo(json.dumps(content))
    try:
        run_workers(
            address,
            count,
            share,
            threads=threads,
            away_timeout_s=wait,
            report=lambda sentence: console.print(sentence, highlight=False),
        )
    except TimeoutError as error:
        raise DaemonError(
            certificate_problem(address)
            or f"no scheduler answered at {scheduler} for {wait:.0f} s. "
            "Start one: dask scheduler --host 127.0.0.1 --dashboard-address 127.0.0.1:8787"
        ) from error
