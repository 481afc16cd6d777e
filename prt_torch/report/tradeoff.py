"""The page of a sweep: every error against every cost, where the error comes from, pictures.

One file that needs nothing else, as all pages of the package. Pointing at a result anywhere marks
it everywhere and tells its figures.
"""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from prt_torch import store
from prt_torch.report.numbers import bytes_text, error_text, percent_text, seconds_text
from prt_torch.report.page import POLICY, Picture, left_out_section, pictures_section
from prt_torch.report.style import SORTING, STYLE
from prt_torch.report.tradeoff_svg import TELLING, bars, family_style, legend, plot, told
from prt_torch.tradeoff import COSTS, ERRORS, Stage, error_of, fronts

_COLUMNS = {**COSTS, **ERRORS}
_PLOTTED = ("transfer_error", "mean_radiance_error")  # of one bake, the others say the same


def write_tradeoff(
    path: Path,
    report: Mapping[str, Any],
    *,
    stages: Sequence[Stage] = (),
    stages_of: str = "",
    pictures: Sequence[Picture] = (),
) -> None:
    """Write the page, atomically.

    Args:
        path: The file.
        report: Of a sweep.
        stages: Its waterfall, if there is one.
        stages_of: What the waterfall is of, in a few words.
        pictures: Shown in their order, by group.

    Raises:
        InputError: If the file cannot be written.
    """
    results = report["results"]
    families = list(dict.fromkeys(str(one["representation"]) for one in results))
    title = escape(f"{report['scene']['mesh']}: {len(results)} representations")
    sections = [
        _head(report),
        _choice(report.get("budget")),
        _plots(results, families),
        _waterfall(stages, stages_of),
        pictures_section(pictures),
        _table(results),
        left_out_section(report["left_out"]),
        _failed(report.get("failed") or []),
    ]
    store.write_bytes(
        path,
        f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<title>{title}</title>
<style>{STYLE}{family_style(families)}</style>
</head>
<body>
<main>
<h1>{title}</h1>
{"".join(sections)}
<div id="told" class="card">Point at a result for its figures.</div>
</main>
<script>{SORTING}{TELLING}</script>
</body>
</html>
""".encode(),
    )


def _head(report: Mapping[str, Any]) -> str:
    scene, light = report["scene"], report["light"]
    facts = (
        f"{scene['points']:,} points, {scene['material']}; light in {light['basis']}, "
        f"{light['coeffs']} coefficients; {scene['rows']} rows, {scene['channels']} channels; "
        f"uncompressed {bytes_text(report['raw_bytes'])}."
    )
    return f'<p class="lead">{escape(facts)}</p>'


def _choice(budget: Mapping[str, Any] | None) -> str:
    if not budget:
        return ""
    reasons = "".join(f"<li>{escape(one)}</li>" for one in budget["why"])
    return f"""<section><h2>Within the budget</h2>
<div class="card tile"><div class="label">{escape(budget["asked"])}</div>
<div class="value">{escape(budget["name"])}</div><ul>{reasons}</ul></div></section>
"""


def _plots(results: Sequence[Mapping[str, Any]], families: Sequence[str]) -> str:
    known = [key for key in _PLOTTED if any(error_of(one, key) for one in results)]
    panels = "".join(
        f'<div class="card plot">{plot(results, cost, error)}</div>\n'
        for cost in COSTS
        for error in known
    )
    return f"""<section><h2>Error against cost</h2>
{legend(families)}
<p class="note">Lower and further left is better; axes are logarithmic. Thin lines join what no
other of its family beats, the broad one what nothing beats. Filled points were fitted, hollow ones
read off a larger fit, which loses a little against a fit of their own. Radiance errors are means
over lights that took no part in any fit.</p>
<div class="plots">{panels}</div></section>
"""


def _waterfall(stages: Sequence[Stage], what: str) -> str:
    if not stages:
        return ""
    return f"""<section><h2>Where the error comes from</h2>
<p class="note">{escape(what)} Squared relative error of radiance under the held-out lights as
approximations are switched on one after the other: signed differences, which add up to the total
exactly; and what each does with none of the others.</p>
<div class="card plot">{bars(stages)}</div></section>
"""


def _table(results: Sequence[Mapping[str, Any]]) -> str:
    unbeaten = set(fronts(results, "bytes", "mean_radiance_error").get("joint", []))
    head = "".join(
        f'<th scope="col" class="{kind}"><button type="button">{escape(text)}</button></th>'
        for text, kind in [("Name", "text"), *((one, "") for one in _COLUMNS.values())]
    )
    body = "".join(_row(one, str(one["name"]) in unbeaten) for one in results)
    return f"""<section><h2>All results</h2>
<div class="card scroll"><table><thead><tr>{head}</tr></thead>
<tbody>{body}</tbody></table></div>
<p class="note">A star: nothing has less radiance error in fewer bytes. A click on a heading
sorts.</p></section>
"""


def _row(result: Mapping[str, Any], unbeaten: bool) -> str:
    name = str(result["name"])
    cells = []
    for key in _COLUMNS:
        value = error_of(result, key) if key in ERRORS else result.get(key)
        text = {
            "bytes": bytes_text,
            "seconds": seconds_text,
            "error": percent_text if key == "mean_radiance_error" else error_text,
        }[key.rpartition("_")[2]](value)
        cells.append(f'<td data-value="{"" if value is None else value}">{escape(text)}</td>')
    data = escape(name, quote=True)
    line = escape(told(result), quote=True)
    shown = escape(name) + (" ★" if unbeaten else "")
    first = f'<td class="text name" data-value="{data}" data-name="{data}" data-told="{line}">'
    return f"<tr>{first}{shown}</td>{''.join(cells)}</tr>\n"


def _failed(entries: Sequence[Mapping[str, str]]) -> str:
    if not entries:
        return ""
    listed = "".join(f"<li>{escape(one['what'])}: {escape(one['why'])}</li>" for one in entries)
    return f"""<section><h2>What does not suit the scene</h2>
<ul class="warnings">{listed}</ul></section>
"""
