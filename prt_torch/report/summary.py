"""The results and the solves as tables for the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from prt_torch.report.numbers import (
    bytes_text,
    digits_text,
    error_text,
    factor_text,
    percent_text,
    seconds_text,
)
from prt_torch.report.outcome import ENDINGS, endings, environments, outcomes

_STYLES = {"good": "", "warn": "yellow", "bad": "red"}


def summary_table(report: Mapping[str, Any]) -> Table:
    """One line a result: storage, errors, times, and how the fit ended.

    Args:
        report: A run dictionary, or several gathered.
    """
    rows = outcomes(report)
    lights = environments(rows)
    table = Table(header_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    # On a narrow terminal names wrap first; an error is never cut.
    table.add_column("name", overflow="fold")
    table.add_column("bytes", justify="right")
    table.add_column("smaller", justify="right")
    for heading in ("transfer\nerror", "reference\nerror"):
        table.add_column(heading, justify="right", no_wrap=True)
    for light in lights:
        table.add_column(Text(f"radiance\n{light}"), justify="right")
    for heading in ("fit", "relight", "faster"):
        table.add_column(heading, justify="right")
    table.add_column("status", overflow="fold")
    for row in rows:
        cells = [
            row.name,
            bytes_text(row.bytes),
            factor_text(row.ratio),
            error_text(row.transfer_error),
            error_text(row.reference_error),
            *(percent_text(row.radiance_error.get(light)) for light in lights),
            seconds_text(row.fit_seconds),
            seconds_text(row.relight_seconds),
            factor_text(row.speed_up),
        ]
        style = _STYLES[ENDINGS.get(row.status, ("warn", ""))[0]]
        # Text, not markup: names may hold brackets.
        table.add_row(*(Text(cell) for cell in cells), Text(row.status, style=style))
    return table


def solves_table(report: Mapping[str, Any]) -> Table:
    """One line a solve: its condition, the digits that may cost, and how it ended.

    Args:
        report: A run dictionary, or several gathered.
    """
    table = Table(header_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("solve", overflow="fold")
    table.add_column("condition", justify="right", no_wrap=True)
    table.add_column("digits lost", justify="right")
    table.add_column("status", overflow="fold")
    for one in endings(report):
        told = (one.what, error_text(one.condition), digits_text(one.digits_lost))
        table.add_row(*(Text(cell) for cell in told), Text(one.status, style=_STYLES[one.rating]))
    return table
