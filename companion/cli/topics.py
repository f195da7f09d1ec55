"""The command line of `companion topics`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.flags import plain_errors


def topics(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per line.")] = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown table.")] = False,
    schema: Annotated[
        Path | None, typer.Option(help="Folder: write the JSON Schema of each topic as NAME.schema.json.")
    ] = None,
) -> None:
    """List the published topics. Prints what they hold, their rate and maximum age."""
    from companion.bus.schema import COLUMNS, topic_rows, topic_table, topics_markdown, write_schemas

    if schema is not None:
        with plain_errors(OSError):
            for path in write_schemas(schema):
                typer.echo(path)
        return
    if as_markdown:
        typer.echo(topics_markdown(), nl=False)
        return
    if as_json:
        for row in topic_table():
            typer.echo(json.dumps(row))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(*COLUMNS)
    for cells in topic_rows():
        table.add_row(*cells)
    Console(width=None if sys.stdout.isatty() else 160).print(table)
