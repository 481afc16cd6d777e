"""What the stability suite tells: a line a row while it runs, Markdown, JSON and one HTML file."""

import math
import platform
import time
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from rich.text import Text
from stability_case import DTYPES, Check, number_text
from stability_runner import Row, type_name

from prt_torch import store
from prt_torch.report.style import STYLE

_HEADINGS = ("case", "input", "required", "float32", "float64", "condition", "seconds", "result")
_POLICY = "default-src 'none'; style-src 'unsafe-inline'"


def line(row: Row, *, heading: bool) -> Table:
    """A row for the terminal: of each type the check that is nearest to its limit.

    Args:
        row: What to show.
        heading: Whether to show the names of the columns above.
    """
    table = Table(box=None, show_header=heading, padding=(0, 1, 0, 0))
    for name, width in (("result", 6), ("case", 38), ("float32", 44), ("float64", 44)):
        table.add_column(name, width=width)
    table.add_column("condition", width=9, justify="right")
    table.add_column("seconds", width=7, justify="right")
    verdict = Text("pass", "green") if row.passed else Text("RED", "bold red")
    told = [Text(_nearest(row, type_name(dtype))) for dtype in DTYPES]
    name = Text(row.case.name)
    table.add_row(verdict, name, *told, _condition(row), f"{row.seconds:.1f}")
    return table


def _nearest(row: Row, name: str) -> str:
    """The check nearest to its limit; all that fail, where some do."""
    outcome = row.outcomes.get(name)
    if outcome is None:
        return row.failure
    failed = [check.text for check in outcome.checks if not check.passed]
    if failed:
        return "; ".join(failed)
    return max(outcome.checks, key=lambda check: check.strain).text


def _condition(row: Row) -> str:
    return "" if row.condition is None else number_text(row.condition)


def write(out: Path, rows: Sequence[Row], *, seeds: int) -> None:
    """Write ``stability.md``, ``stability.json`` and ``stability.html`` into a folder.

    Args:
        out: The folder; made if need be.
        rows: All rows that were run.
        seeds: Of cases that run over seeds.

    Raises:
        InputError: If a file cannot be written.
    """
    store.write_json(out / "stability.json", _content(rows, seeds))
    store.write_bytes(out / "stability.md", _markdown(rows, seeds).encode())
    store.write_bytes(out / "stability.html", _html(rows, seeds).encode())


def _summary(rows: Sequence[Row], seeds: int) -> str:
    red = [row.case.name for row in rows if not row.passed]
    seconds = sum(row.seconds for row in rows)
    verdict = f"{len(red)} red: {', '.join(red)}" if red else "all pass"
    return (
        f"{len(rows)} cases, {verdict}. {seeds} seeds, {seconds:.0f} s on one thread, "
        f"{time.strftime('%Y-%m-%d')}, {platform.machine()}, torch {torch.__version__}."
    )


def _json_number(value: float | None) -> float | str | None:
    """JSON has neither NaN nor infinity."""
    return value if value is None or math.isfinite(value) else str(value)


def _json_check(check: Check) -> dict[str, Any]:
    limits = {"least": check.least, "most": check.most}
    known = {name: limit for name, limit in limits.items() if math.isfinite(limit)}
    value = _json_number(check.value)
    return {"what": check.what, "value": value, **known, "passed": check.passed}


def _content(rows: Sequence[Row], seeds: int) -> dict[str, Any]:
    return {
        "summary": _summary(rows, seeds),
        "seeds": seeds,
        "torch": torch.__version__,
        "rows": [
            {
                "name": row.case.name,
                "source": row.case.source,
                "input": row.case.given,
                "required": row.case.required,
                "passed": row.passed,
                "failure": row.failure,
                "condition": _json_number(row.condition),
                "seconds": row.seconds,
                "limit_seconds": row.case.seconds,
                **{
                    name: {
                        "checks": [_json_check(check) for check in outcome.checks],
                        "note": outcome.note,
                    }
                    for name, outcome in row.outcomes.items()
                },
            }
            for row in rows
        ],
    }


def _told(row: Row, name: str) -> list[str]:
    """All checks of a type, a note, or why there are none."""
    outcome = row.outcomes.get(name)
    if outcome is None:
        return [row.failure]
    lines = [("" if check.passed else "RED: ") + check.text for check in outcome.checks]
    return [*lines, *([outcome.note] if outcome.note else [])]


def _cells(row: Row) -> list[list[str]]:
    """Lines of each cell, in the order of the headings."""
    case = row.case
    told = [_told(row, type_name(dtype)) for dtype in DTYPES]
    result = "pass" if row.passed else "RED"
    short = [[case.name], [case.given], [case.required]]
    return [*short, *told, [_condition(row)], [f"{row.seconds:.1f}"], [result]]


def _sections(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by their source, in order."""
    sections: dict[str, list[Row]] = {}
    for row in rows:
        sections.setdefault(row.case.source, []).append(row)
    return sections


def _markdown(rows: Sequence[Row], seeds: int) -> str:
    lines = ["# Stability", "", _summary(rows, seeds)]
    for source, own in _sections(rows).items():
        lines += ["", f"## {source}", "", _markdown_line(list(_HEADINGS))]
        lines.append(_markdown_line(["---"] * len(_HEADINGS)))
        for row in own:
            cells = ["<br>".join(one.replace("|", "\\|") for one in cell) for cell in _cells(row)]
            lines.append(_markdown_line(cells))
    return "\n".join(lines) + "\n"


def _markdown_line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _html(rows: Sequence[Row], seeds: int) -> str:
    heads = "".join(f'<th class="text">{name}</th>' for name in _HEADINGS)
    sections = "".join(
        f'<h2>{escape(source)}</h2>\n<div class="card scroll"><table><thead><tr>{heads}</tr>'
        f"</thead><tbody>{''.join(map(_html_row, own))}</tbody></table></div>\n"
        for source, own in _sections(rows).items()
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<title>Stability</title>
<style>{STYLE}td {{ vertical-align: top; }}</style>
</head>
<body>
<main>
<header><h1>Stability</h1><p class="lead">{escape(_summary(rows, seeds))}</p></header>
{sections}</main>
</body>
</html>
"""


def _html_row(row: Row) -> str:
    *cells, result = ["<br>".join(map(escape, cell)) for cell in _cells(row)]
    badge = f'<span class="badge {"good" if row.passed else "bad"}">{result}</span>'
    body = "".join(f'<td class="text wide">{cell}</td>' for cell in cells)
    return f'<tr>{body}<td class="text">{badge}</td></tr>\n'
