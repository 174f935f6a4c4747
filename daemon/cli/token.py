"""`syntopic token`: who may command the service over the network."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from daemon.cli.options import AsJson
from daemon.terminal.console import Console, light_table

app = typer.Typer(
    help="""Create and revoke access tokens for the API and the operator's page.

Examples: `syntopic token add operator --role operator`, `syntopic token list`
""",
    rich_markup_mode="markdown",
    no_args_is_help=True,
)
TokenFile = Annotated[Path, typer.Option("--file", help="Token file, as in [watch] tokens.")]
DEFAULT_FILE = Path("/etc/syntopic/tokens.toml")


@app.command()
def add(
    name: Annotated[str, typer.Argument(help="Name of the person or program.")],
    role: Annotated[
        str, typer.Option(help="Role: observer, operator or administrator.")
    ] = "observer",
    file: TokenFile = DEFAULT_FILE,
    as_json: AsJson = False,
) -> None:
    """Create a token and print it once.

    Example: `syntopic token add operator --role operator`
    """
    from daemon.onboard.monitoring.access.roles import ROLES
    from daemon.onboard.monitoring.access.tokens import TokenError, add_token

    chosen = next((known for known in ROLES if known == role), None)
    if chosen is None:
        raise TokenError(f"--role {role}: it is one of {', '.join(ROLES)}")
    token = add_token(file, name, chosen)
    if as_json:
        typer.echo(json.dumps({"name": name, "role": role, "token": token, "file": str(file)}))
        return
    typer.echo(token)
    Console(stderr=True, soft_wrap=True).print(
        f"It is not shown again; {file} holds its hash. The service reads the file when it starts."
    )


@app.command()
def remove(
    name: Annotated[str, typer.Argument(help="Name of the token.")],
    file: TokenFile = DEFAULT_FILE,
    as_json: AsJson = False,
) -> None:
    """Revoke a token.

    Example: `syntopic token remove operator`
    """
    from daemon.onboard.monitoring.access.tokens import remove_token

    remove_token(file, name)
    if as_json:
        typer.echo(json.dumps({"name": name, "removed": True, "file": str(file)}))
    typer.echo(f"{name} has no token any more; restart the service to make it so")


@app.command(name="list")
def list_(
    file: TokenFile = DEFAULT_FILE,
    as_json: AsJson = False,
) -> None:
    """List the tokens with their roles.

    Example: `syntopic token list --file tokens.toml`
    """
    from daemon.onboard.monitoring.access.tokens import read_tokens

    holders = sorted(read_tokens(file).holders.values(), key=lambda holder: holder.name)
    if as_json:
        typer.echo(json.dumps({holder.name: holder.role for holder in holders}))
        return
    table = light_table(f"Tokens of {file}", ("name", "role"), ())
    for holder in holders:
        table.add_row(holder.name, holder.role)
    Console().print(table)
