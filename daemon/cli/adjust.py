"""`syntopic adjust`: bundle adjustment of a project of text files."""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer
from rich.progress import Progress

from daemon.cli.exit_status import ExitStatus
from daemon.cli.options import AsJson
from daemon.configuration.model import ConfigurationError
from daemon.terminal.console import Console

if TYPE_CHECKING:
    from processing.bundle.critical_values import TestName
    from processing.bundle.free_datum import FreeDatum
    from processing.bundle.robust_weights import WeightFunction

HELP = """Adjust a bundle from a project of text files.

The project is written by hand or by `syntopic import dbat`.

Prints sigma0, redundancy, residuals by kind, interior orientation with standard deviations, and
check points against their predicted accuracy. With --out the adjusted project, coordinates and
residuals are written as tables. Parameters that cannot be determined are named. With sigma0 beyond
20 the block is inconsistent: likely mistakes are named, and the exit status is 1. The format is
described in docs/reference/formats.md.

Examples: `syntopic adjust project.toml`,
`syntopic adjust project.toml --significance 0.05 --out adjusted`,
`syntopic adjust project.toml --robust --weight-function tukey --reject 4`,
`syntopic adjust project.toml --protocol protocol.txt --covariance covariances.npz`
"""


def adjust(
    project: Annotated[Path, typer.Argument(help="project.toml, or the folder that holds it.")],
    out: Annotated[Path | None, typer.Option(help="Folder for results; must be new.")] = None,
    robust: Annotated[
        bool | None, typer.Option("--robust/--no-robust", help="Robust weights at the start.")
    ] = None,
    weight_function: Annotated[
        str | None,
        typer.Option(help="Robust weights: huber, cauchy, tukey or danish (default: huber)."),
    ] = None,
    reject: Annotated[
        float | None, typer.Option(help="Rejection limit of observations in sigmas.", min=1.0)
    ] = None,
    significance: Annotated[
        float | None,
        typer.Option(
            help="Significance of data snooping over the whole block instead of a limit.",
            min=1e-12,
            max=0.999,
        ),
    ] = None,
    test: Annotated[
        str | None,
        typer.Option(
            help="Residuals tested a posteriori (pope) or a priori (baarda) (default: pope)."
        ),
    ] = None,
    components: Annotated[
        bool | None, typer.Option("--components/--no-components", help="Variance components.")
    ] = None,
    free_network: Annotated[
        bool | None,
        typer.Option("--free-network/--no-free-network", help="Accept a network without datum."),
    ] = None,
    free_datum: Annotated[
        str | None,
        typer.Option(
            help="Datum of a free network: unknowns, points, stations, all or dependent "
            "(default: unknowns)."
        ),
    ] = None,
    join: Annotated[
        bool,
        typer.Option(
            "--join",
            help="Join object points of no common image whose adjusted coordinates agree, and "
            "adjust again.",
        ),
    ] = False,
    covariance: Annotated[
        Path | None,
        typer.Option(help="File for covariances (.npz): of all orientations, and of each point."),
    ] = None,
    covariance_point: Annotated[
        list[str] | None,
        typer.Option(
            help="Object point whose covariances with all orientations and the other such points "
            "are in --covariance; repeatable."
        ),
    ] = None,
    protocol: Annotated[
        Path | None, typer.Option(help="File for the protocol of the adjustment as plain text.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    from daemon.mission.store.output_places import refuse_foreign_file
    from daemon.postflight.adjustment.contradictions import SUSPICIOUS_SIGMA0
    from daemon.postflight.adjustment.covariance_file import is_covariances, write_covariances
    from daemon.postflight.adjustment.likely_mistakes import control_sentences, likely_mistakes
    from daemon.postflight.adjustment.project import read_project
    from daemon.postflight.adjustment.project_writer import refuse_existing_project, write_results
    from daemon.postflight.adjustment.protocol import is_protocol, write_protocol
    from daemon.postflight.adjustment.summary import print_report, report_of
    from daemon.postflight.adjustment.variance_factors import variance_factor_cautions
    from processing.bundle.adjust import adjust as adjusted
    from processing.bundle.network import NetworkError
    from processing.bundle.point_joining import joined_points, named_points
    from processing.bundle.rank_diagnosis import RankDefectError
    from processing.bundle.staged_adjustment import adjust_in_stages

    _refuse_unknown_choices(weight_function, test, free_datum)
    if free_datum is not None and free_network is False:
        raise ConfigurationError(["--free-datum is of a free network; leave out --no-free-network"])
    if reject is not None and significance is not None:
        raise ConfigurationError(["--reject and --significance both set the limit; give one"])
    if covariance_point and covariance is None:
        raise ConfigurationError(["--covariance-point needs --covariance, the file it is for"])
    if out is not None:
        refuse_existing_project(out)
    if covariance is not None:
        refuse_foreign_file(covariance, is_covariances, cure="give another name with --covariance")
    if protocol is not None:
        refuse_foreign_file(protocol, is_protocol, cure="give another name with --protocol")
    path = project / "project.toml" if project.is_dir() else project
    begun = time.perf_counter()
    given = read_project(path)
    settings = given.settings
    if robust is not None:
        settings = replace(settings, robust=robust)
    if weight_function is not None:
        settings = replace(
            settings, robust=True, weight_function=cast("WeightFunction", weight_function)
        )
    if reject is not None:
        settings = replace(settings, reject_beyond=reject, significance=None)
    if significance is not None:
        settings = replace(settings, significance=significance, reject_beyond=None)
    if test is not None:
        settings = replace(settings, test=cast("TestName", test))
    if components is not None:
        settings = replace(settings, variance_components=components)
    if free_network is not None:
        settings = replace(settings, minimum_norm=free_network)
    if free_datum is not None:
        settings = replace(settings, minimum_norm=True, free_datum=cast("FreeDatum", free_datum))
    settings = replace(settings, retained=tuple(covariance_point or ()))
    problems: tuple[str, ...] = ()
    try:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("starting values", total=None)

            def show(what: str, number: int, squares: float) -> None:
                progress.update(task, description=f"{what} {number}: {squares:.6g}")

            result = adjust_in_stages(given.network, settings, progress=show)
            joined = 0
            if join:
                network, joined = joined_points(
                    result.network,
                    result.state.points,
                    result.point_cofactor * result.sigma0**2,
                    named_points(result.network, given.checks.names),
                )
            if joined:
                result = adjusted(network, settings, progress=show)
    except NetworkError as error:
        problems = error.problems
    except RankDefectError as error:
        problems = control_sentences(given.network, error.rank_defects)
    if problems:
        problems = (*problems, *likely_mistakes(given.network, None))
        if as_json:
            typer.echo(json.dumps({"name": given.name, "problems": list(problems)}))
        else:
            console = Console(stderr=True, soft_wrap=True)
            for problem in problems:
                console.print(problem, style="red", markup=False, highlight=False)
        raise typer.Exit(ExitStatus.PROBLEM)
    if join:
        Console(stderr=True).print(f"{joined} object points were joined with others")
    report = report_of(
        result,
        given.checks,
        name=given.name,
        seconds=time.perf_counter() - begun,
        peak_mib=_peak_mib(),
    )
    report["cautions"] = [*given.cautions, *report["cautions"]]
    if result.sigma0 > SUSPICIOUS_SIGMA0:
        explained = likely_mistakes(given.network, result.sigma0)
        report["cautions"] += explained or variance_factor_cautions(result)
    if out is not None:
        write_results(out, given, result, report)
    if covariance is not None:
        write_covariances(covariance, result)
    if protocol is not None:
        write_protocol(protocol, result, given.checks, report)
    if as_json:
        typer.echo(json.dumps(report))
    else:
        console = Console()
        print_report(console, report)
        if out is not None:
            console.print(f"Results: {out}", soft_wrap=True)
    if result.problems or result.sigma0 > SUSPICIOUS_SIGMA0:
        raise typer.Exit(ExitStatus.PROBLEM)


def _refuse_unknown_choices(
    weight_function: str | None, test: str | None, free_datum: str | None
) -> None:
    problems = []
    if weight_function not in (None, "huber", "cauchy", "tukey", "danish"):
        problems.append(f"--weight-function is {weight_function}; huber, cauchy, tukey or danish")
    if test not in (None, "pope", "baarda"):
        problems.append(f"--test is {test}; pope or baarda")
    if free_datum not in (None, "unknowns", "points", "stations", "all", "dependent"):
        problems.append(
            f"--free-datum is {free_datum}; unknowns, points, stations, all or dependent"
        )
    if problems:
        raise ConfigurationError(problems)


def _peak_mib() -> float:
    """Largest resident memory of this process so far."""
    per_mib = 1024.0 if sys.platform != "darwin" else 1024.0**2
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / per_mib
