"""One HTML file that shows a run to a colleague: it needs nothing but itself.

Pictures are inside it, fonts are the reader's, and its content policy forbids the browser to load
anything else. All text of the run is escaped.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from matplotlib import colormaps
from matplotlib.colors import to_hex

from prt_torch import store
from prt_torch.preview import ERROR_COLORMAP
from prt_torch.report.numbers import (
    bytes_text,
    count_text,
    digits_text,
    error_text,
    factor_text,
    percent_text,
    seconds_text,
)
from prt_torch.report.outcome import (
    Ending,
    Number,
    Outcome,
    Run,
    endings,
    environments,
    number,
    outcomes,
    runs,
)
from prt_torch.report.plots import DARK, LIGHT, error_against_bytes, error_against_time
from prt_torch.report.style import SORTING, STYLE

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""What a page may load: nothing that is not in it."""


@dataclass(frozen=True)
class Picture:
    """A picture of the page.

    Attributes:
        title: What it shows, such as a result's name.
        caption: One line more; may be empty.
        png: The file.
        group: Pictures of one group stand together under this heading, in the order given.
        scale: For error maps, what the brightest colour stands for; a bar shows it.
    """

    title: str
    caption: str
    png: bytes
    group: str
    scale: float | None = None


def write_html(path: Path, report: Mapping[str, Any], pictures: Sequence[Picture]) -> None:
    """Write the page, atomically.

    Args:
        path: The file.
        report: A run dictionary, or several gathered.
        pictures: Shown in their order, by group.

    Raises:
        InputError: If the file cannot be written.
    """
    rows = outcomes(report)
    sections = [
        _summary(report, rows),
        _results(rows),
        _plots(report),
        pictures_section(pictures),
        left_out_section(report.get("left_out") or []),
        _endings(endings(report)),
    ]
    title = escape(_title(report))
    store.write_bytes(
        path,
        f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<title>{title} – transfer report</title>
<style>{STYLE}</style>
</head>
<body>
<main>
{"".join(sections)}</main>
<script>{SORTING}</script>
</body>
</html>
""".encode(),
    )


def _title(report: Mapping[str, Any]) -> str:
    meshes = dict.fromkeys(Path(str(run.scene.get("mesh", "scene"))).name for run in runs(report))
    return ", ".join(meshes)


def _summary(report: Mapping[str, Any], rows: Sequence[Outcome]) -> str:
    all_runs = runs(report)
    bases = dict.fromkeys(str(run.light.get("basis", "")) for run in all_runs)
    plural = "" if len(rows) == 1 else "s"
    lead = f"{len(rows)} compressed representation{plural} of precomputed transfer, light in "
    lead += ", ".join(basis for basis in bases if basis) or "an unnamed basis"
    facts = "".join(f'<div class="facts">{_facts(run)}</div>' for run in all_runs)
    noted = "".join(f"<li>{escape(message)}</li>" for message in _warnings(all_runs))
    return f"""<header><h1>{escape(_title(report))}</h1>
<p class="lead">{escape(lead)}</p></header>
<section><div class="tiles">{_tiles(all_runs, rows)}</div>
{facts}
{f'<ul class="warnings">{noted}</ul>' if noted else ""}</section>
"""


def _warnings(all_runs: Sequence[Run]) -> list[str]:
    """Warnings of the meshes; those that not all runs share begin with the runs they are of."""
    owners: dict[str, list[str]] = {}
    for run in all_runs:
        for warning in run.scene.get("warnings") or []:
            owners.setdefault(str(warning["message"]), []).append(run.name)
    return [
        message if len(names) == len(all_runs) else f"{', '.join(names)}: {message}"
        for message, names in owners.items()
    ]


def _tiles(all_runs: Sequence[Run], rows: Sequence[Outcome]) -> str:
    raw = sorted({run.raw_bytes for run in all_runs if run.raw_bytes is not None})
    tiles = [("Uncompressed", " – ".join(bytes_text(size) for size in raw), "transfer tensor")]
    # Across light bases only the error against the full resolution compares.
    error = (
        (lambda row: row.reference_error) if len(all_runs) > 1 else (lambda row: row.transfer_error)
    )
    smallest = max((row for row in rows if row.ratio), key=lambda row: row.ratio or 0, default=None)
    if smallest:
        value = f"{factor_text(smallest.ratio)} smaller"
        tiles.append(("Smallest", value, f"{smallest.name}, error {error_text(error(smallest))}"))
    fastest = max(
        (row for row in rows if row.speed_up), key=lambda row: row.speed_up or 0, default=None
    )
    if fastest:
        time = f"{fastest.name}, {seconds_text(fastest.relight_seconds)} a light"
        tiles.append(("Fastest", f"{factor_text(fastest.speed_up)} faster", time))
    best = min((row for row in rows if error(row) is not None), key=error, default=None)
    if best:
        size = f"{best.name}, {factor_text(best.ratio)} smaller"
        tiles.append(("Most accurate", f"error {error_text(error(best))}", size))
    return "".join(
        f'<div class="card tile"><div class="label">{label}</div>'
        f'<div class="value">{escape(value)}</div><div class="of">{escape(of)}</div></div>'
        for label, value, of in tiles
    )


def _facts(run: Run) -> str:
    """Scene, light and bake of one run, as three cards."""
    scene = {
        "mesh": run.scene.get("mesh"),
        "points": _count(run.scene.get("points")),
        "faces": _count(run.scene.get("faces")),
        "material": run.scene.get("material"),
        "rows, channels": f"{run.scene.get('rows', '–')}, {run.scene.get('channels', '–')}",
    }
    light = {
        "basis": run.light.get("basis"),
        "coefficients": _count(run.light.get("coeffs")),
        "uncompressed": bytes_text(run.raw_bytes),
    }
    bake = {
        "time": seconds_text(number(run.bake.get("seconds"))),
        "rays": _count(run.bake.get("rays")),
        "from the cache": "yes" if run.bake.get("cached") else "no",
        "bounces": _bounces(run.bake.get("bounces")),
        "BRDF factors": _factors(run.bake.get("factor_error")),
    }
    return "".join(
        _fact_card(f"{run.name}: {title}" if run.name else title.capitalize(), facts)
        for title, facts in (("scene", scene), ("light", light), ("bake", bake))
    )


def _bounces(added: Any) -> str | None:
    """How many, and what the last one added; None where none were gathered."""
    if not added:
        return None
    return f"{len(added)}, the last added {error_text(number(added[-1]))} of the light"


def _factors(error: Any) -> str | None:
    """How far factors are from their materials; None where there are none."""
    return (
        None if error is None else f"off by {percent_text(number(error))} RMS over all directions"
    )


def _fact_card(title: str, facts: Mapping[str, Any]) -> str:
    pairs = "".join(
        f"<dt>{escape(key)}</dt><dd>{escape(str(value))}</dd>"
        for key, value in facts.items()
        if value is not None
    )
    return f'<div class="card"><h3>{escape(title)}</h3><dl>{pairs}</dl></div>'


def _count(value: Any) -> str:
    return count_text(number(value))


@dataclass(frozen=True)
class _Cell:
    text: str
    value: Number | str
    kind: str = ""


def _results(rows: Sequence[Outcome]) -> str:
    lights = environments(rows)
    drawn = any(row.overdraw is not None for row in rows)
    headings = [
        ("Name", "text"),
        ("Bytes", ""),
        ("Smaller", ""),
        ("Transfer\nerror", ""),
        ("Reference\nerror", ""),
        *((f"Radiance error\n{light}", "") for light in lights),
        ("Fit", ""),
        ("Relight", ""),
        ("Faster", ""),
        ("Peak\nmemory", ""),
        *((("Overdraw,\nmerged", ""),) if drawn else ()),
        ("Parameters", "text"),
    ]
    cells = [
        [
            _Cell(row.name, row.name, "text name"),
            _Cell(bytes_text(row.bytes), row.bytes),
            _Cell(factor_text(row.ratio), row.ratio),
            _Cell(error_text(row.transfer_error), row.transfer_error),
            _Cell(error_text(row.reference_error), row.reference_error),
            *(_percent_cell(row.radiance_error.get(light)) for light in lights),
            _Cell(seconds_text(row.fit_seconds), row.fit_seconds),
            _Cell(seconds_text(row.relight_seconds), row.relight_seconds),
            _Cell(factor_text(row.speed_up), row.speed_up),
            _Cell(bytes_text(row.peak_bytes), row.peak_bytes),
            *((_overdraw_cell(row),) if drawn else ()),
            _Cell(row.parameters, row.parameters, "text wide"),
        ]
        for row in rows
    ]
    return f"""<section><h2>Results</h2>
{_table(headings, cells)}
<p class="note">Bytes count everything needed to relight. Transfer error is squared error over
squared norm of the uncompressed tensor; reference error the same against the bake at full
resolution, so it compares across light bases. Radiance error is the relative root mean square under
lights that took no part in the fit. Overdraw is how often a face is drawn, by clusters and by
clusters merged into what 256 registers hold. Smaller and faster are against the uncompressed
tensor, on the same machine in the same run. A click on a heading sorts.</p></section>
"""


def _overdraw_cell(row: Outcome) -> _Cell:
    if row.overdraw is None or row.overdraw_merged is None:
        return _Cell("–", None)
    return _Cell(f"{row.overdraw:.2f}, {row.overdraw_merged:.2f}", row.overdraw)


def _percent_cell(value: Number) -> _Cell:
    return _Cell(percent_text(value), value)


def _table(headings: Iterable[tuple[str, str]], rows: Iterable[Sequence[_Cell]]) -> str:
    head = "".join(
        f'<th scope="col" class="{kind}"><button type="button">{escape(text)}</button></th>'
        for text, kind in headings
    )
    body = "".join(f"<tr>{''.join(_cell(cell) for cell in row)}</tr>\n" for row in rows)
    return (
        f'<div class="card scroll"><table><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )


def _cell(cell: _Cell) -> str:
    value = "" if cell.value is None else escape(str(cell.value))
    badge = cell.kind.split("badge ")[-1] if "badge " in cell.kind else ""
    text = escape(cell.text)
    if badge:
        return (
            f'<td class="text" data-value="{value}"><span class="badge {badge}">{text}</span></td>'
        )
    return f'<td class="{cell.kind}" data-value="{value}">{text}</td>'


def _plots(report: Mapping[str, Any]) -> str:
    figures = "".join(
        '<div class="card plot"><picture><source media="(prefers-color-scheme: dark)" '
        f'srcset="{_data(plot(report, palette=DARK))}">'
        f'<img alt="{alt}" src="{_data(plot(report, palette=LIGHT))}"></picture></div>\n'
        for plot, alt in (
            (error_against_bytes, "Error against storage"),
            (error_against_time, "Error against the time of one relighting"),
        )
    )
    return f"""<section><h2>Trade-offs</h2>
<p class="note">Lower and further left is better; both axes are logarithmic. The star is the
uncompressed tensor; the dashed line stands for an error of 0, or one of rounding alone.</p>
{figures}</section>
"""


def _data(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def pictures_section(pictures: Sequence[Picture]) -> str:
    """Pictures in their groups, as a section of a page; nothing where there are none."""
    if not pictures:
        return ""
    groups = "".join(
        f'<h3>{escape(group)}</h3>\n<div class="pictures">'
        + "".join(_figure(picture) for picture in pictures if picture.group == group)
        + "</div>\n"
        for group in dict.fromkeys(picture.group for picture in pictures)
    )
    return f"""<section><h2>Pictures</h2>
<p class="note">Pictures of one group share their exposure.</p>
{groups}</section>
"""


def _figure(picture: Picture) -> str:
    bar = ""
    if picture.scale is not None:
        stops = ", ".join(to_hex(colormaps[ERROR_COLORMAP](step / 8)) for step in range(9))
        bar = (
            f'<span class="scale">0<i style="background: linear-gradient(to right, {stops})"></i>'
            f"{picture.scale:.3g}</span>"
        )
    title = escape(picture.title)
    return (
        f'<figure class="card"><img alt="{title}" src="{_data(picture.png)}">'
        f"<figcaption><b>{title}</b>{escape(picture.caption)}{bar}</figcaption></figure>\n"
    )


def left_out_section(entries: Sequence[Mapping[str, Any]]) -> str:
    """What the scene did not need, as a table."""
    if not entries:
        return "<section><h2>What was left out</h2><p>Nothing.</p></section>\n"
    headings = [("What", "text"), ("Why", "text"), ("Saved", "")]
    rows = []
    for entry in entries:
        run = f"{entry['run']}: " if "run" in entry else ""
        what, why = f"{run}{entry['what']}", str(entry["why"])
        size, seconds = number(entry.get("saved_bytes")), number(entry.get("saved_seconds"))
        saved = bytes_text(size) if size is not None else seconds_text(seconds)
        rows.append(
            [
                _Cell(what, what, "text name"),
                _Cell(why, why, "text wide"),
                _Cell(saved, size if size is not None else seconds),
            ]
        )
    return f"""<section><h2>What was left out</h2>
<p class="note">Measured not to be needed for this scene and light; each can be forced on.</p>
{_table(headings, rows)}</section>
"""


def _endings(ended: Sequence[Ending]) -> str:
    if not ended:
        return ""
    headings = [("Solve", "text"), ("Status", "text"), ("Meaning", "text")]
    headings += [("Condition", ""), ("Digits lost", "")]
    cells = [
        [
            _Cell(one.what, one.what, "text name"),
            _Cell(one.status, one.status, f"badge {one.rating}"),
            _Cell(one.meaning, one.meaning, "text wide"),
            _Cell(error_text(one.condition), one.condition),
            _Cell(digits_text(one.digits_lost), one.digits_lost),
        ]
        for one in ended
    ]
    return f"""<section><h2>How it ended</h2>
{_table(headings, cells)}
<p class="note">Condition is how stiff a problem was: errors in the data may grow by as much, which
costs its decimal logarithm in digits. Gram matrices have the square of their functions'.</p>
</section>
"""
