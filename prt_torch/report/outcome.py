"""The run dictionary as typed rows, and several of them joined."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Number = int | float | None
"""A finite number, or None where there is none to show."""

ENDINGS = {
    "solved": ("good", "as it is"),
    "regularised": ("warn", "nearly singular: as much was added as bounds its condition"),
    "closed_form": ("good", "no steps were asked for"),
    "converged": ("good", "steps gained less than the tolerance"),
    "max_steps": ("good", "all steps were taken; more might lower the error further"),
    "stagnated": ("warn", "several steps in a row found nothing better"),
    "interrupted": ("warn", "stopped from outside; the best state so far was kept"),
    "rank_deficient": ("warn", "the data leave some directions undetermined"),
    "nonfinite": ("bad", "a value became infinite or NaN; the best state before that was kept"),
}
"""How a fit or a solve can end: how good that is, and what it means."""


@dataclass(frozen=True)
class Outcome:
    """One result of a report.

    Attributes:
        name: What tables and plots call it; unique in the report.
        run: The run it comes from.
        representation: The family it belongs to.
        parameters: Its budget in words.
        status: How the fit ended.
        condition: How stiff the problem was.
        fit_seconds: Time of the fit [s].
        bytes: Everything needed to relight.
        raw_bytes: The uncompressed tensor.
        transfer_error: Squared error over squared norm, in the tensor's own basis.
        reference_error: The same against the bake at full resolution.
        radiance_error: Relative root mean square by environment.
        relight_seconds: Median time of one relighting [s].
        dense_seconds: The same for the uncompressed tensor [s].
        peak_bytes: Most memory in use while relighting.
        overdraw: How often a face is drawn, on average, by clusters.
        overdraw_merged: The same by superclusters.
    """

    name: str
    run: str
    representation: str
    parameters: str
    status: str
    condition: Number
    fit_seconds: Number
    bytes: Number
    raw_bytes: Number
    transfer_error: Number
    reference_error: Number
    radiance_error: Mapping[str, Number]
    relight_seconds: Number
    dense_seconds: Number
    peak_bytes: Number
    overdraw: Number
    overdraw_merged: Number

    @property
    def ratio(self) -> Number:
        """How many times smaller than the uncompressed tensor."""
        return self.raw_bytes / self.bytes if self.raw_bytes and self.bytes else None

    @property
    def speed_up(self) -> Number:
        """How many times faster than the uncompressed tensor."""
        if not self.dense_seconds or not self.relight_seconds:
            return None
        return self.dense_seconds / self.relight_seconds

    @property
    def mean_radiance_error(self) -> Number:
        """Mean over environments; None if any is missing."""
        values = [value for value in self.radiance_error.values() if value is not None]
        if not values or len(values) < len(self.radiance_error):
            return None
        return sum(values) / len(values)


@dataclass(frozen=True)
class Ending:
    """How one solve of a report ended.

    Attributes:
        what: Which; with its run before it where there are several.
        status: A key of :data:`ENDINGS`.
        condition: None where it is infinite or not known.
        digits_lost: How many decimal digits the condition may cost; None where it is not known.
        warning: What is wrong if it is stiff; else empty.
    """

    what: str
    status: str
    condition: Number
    digits_lost: Number
    warning: str

    @property
    def rating(self) -> str:
        """``good``, ``warn`` or ``bad``."""
        rating = ENDINGS.get(self.status, ("warn", ""))[0]
        return "warn" if self.warning and rating == "good" else rating

    @property
    def meaning(self) -> str:
        """The status in words, and the warning."""
        return "; ".join(filter(None, [ENDINGS.get(self.status, ("", ""))[1], self.warning]))


@dataclass(frozen=True)
class Run:
    """Where results come from.

    Attributes:
        name: What tells it from other runs; empty if there is but one.
        scene: Facts of the scene.
        light: Facts of the light basis.
        bake: Facts of the bake.
        raw_bytes: The uncompressed tensor.
    """

    name: str
    scene: Mapping[str, Any]
    light: Mapping[str, Any]
    bake: Mapping[str, Any]
    raw_bytes: Number


def number(value: Any) -> Number:
    """A finite number, or None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return value


def runs(report: Mapping[str, Any]) -> list[Run]:
    """The runs of a report: several in a gathered one, otherwise one."""
    return [
        Run(
            entry.get("name", ""),
            entry.get("scene") or {},
            entry.get("light") or {},
            entry.get("bake") or {},
            number(entry.get("raw_bytes")),
        )
        for entry in report.get("runs", [report])
    ]


def outcomes(report: Mapping[str, Any]) -> list[Outcome]:
    """The results of a report, in its order."""
    return [_outcome(result, report) for result in report["results"]]


def endings(report: Mapping[str, Any]) -> list[Ending]:
    """The solves of a report, in its order."""
    return [
        Ending(
            what=f"{entry['run']}: {entry['what']}" if "run" in entry else str(entry["what"]),
            status=str(entry.get("status", "")),
            condition=number(entry.get("condition")),
            digits_lost=number(entry.get("digits_lost")),
            warning=str(entry.get("warning") or ""),
        )
        for entry in report.get("solves") or []
    ]


def _outcome(result: Mapping[str, Any], report: Mapping[str, Any]) -> Outcome:
    errors = result.get("radiance_error") or {}
    coherence = result.get("coherence") or {}
    names = ("condition", "fit_seconds", "bytes", "transfer_error", "reference_error")
    more_names = ("relight_seconds", "dense_seconds", "peak_bytes")
    return Outcome(
        name=str(result["name"]),
        run=result.get("run", ""),
        representation=str(result.get("representation", "")),
        parameters=parameters_text(result.get("parameters")),
        status=str(result.get("status", "")),
        raw_bytes=number(result.get("raw_bytes", report.get("raw_bytes"))),
        overdraw=number(coherence.get("overdraw")),
        overdraw_merged=number(coherence.get("overdraw_merged")),
        radiance_error={str(key): number(value) for key, value in errors.items()},
        **{name: number(result.get(name)) for name in (*names, *more_names)},
    )


def parameters_text(parameters: Any) -> str:
    """A representation's budget in words, such as ``num_clusters 64, rank 8``."""
    if isinstance(parameters, Mapping):
        return ", ".join(f"{name} {value}" for name, value in parameters.items())
    return "" if parameters is None else str(parameters)


def environments(rows: Sequence[Outcome]) -> list[str]:
    """All environments with a radiance error, in order of appearance."""
    return list(dict.fromkeys(name for row in rows for name in row.radiance_error))


def uncompressed_reference_error(rows: Sequence[Outcome]) -> Number:
    """What the light basis of one run cut off, found from the two errors of any one result.

    With b lost by the basis, a transfer error t shows as ``b + t (1 - b)`` against the reference.
    The most accurate result loses the fewest digits.
    """
    known = [
        (row.transfer_error, row.reference_error)
        for row in rows
        if row.transfer_error is not None and row.reference_error is not None
    ]
    if not known:
        return None
    transfer, reference = min(known)
    return max((reference - transfer) / (1 - transfer), 0.0) if transfer < 1 else None


def gather(
    reports: Sequence[Mapping[str, Any]], names: Sequence[str] | None = None
) -> dict[str, Any]:
    """Results of several runs side by side, as one report that this package reads.

    Args:
        reports: Run dictionaries.
        names: What to call the runs; ``run 1``, ``run 2`` if None. A run's name goes before that
            of a result which another run has too.

    Raises:
        ValueError: If there are no reports, or names are not unique, one for each.
    """
    names = list(names) if names else [f"run {index + 1}" for index in range(len(reports))]
    if not reports or len(names) != len(reports) or len(set(names)) < len(names):
        raise ValueError(f"expected a distinct name for each of {len(reports)} reports: {names}")
    shared = ("scene", "light", "bake", "raw_bytes")
    owners: dict[str, int] = {}
    for report in reports:
        for result_name in {result["name"] for result in report["results"]}:
            owners[result_name] = owners.get(result_name, 0) + 1
    results = []
    for run, report in zip(names, reports, strict=True):
        for result in report["results"]:
            name = result["name"]
            unique = name if owners[name] == 1 else f"{run}: {name}"
            raw_bytes = report.get("raw_bytes")
            results.append({**result, "name": unique, "run": run, "raw_bytes": raw_bytes})
    return {
        "runs": [
            {"name": run, **{key: report.get(key) for key in shared}}
            for run, report in zip(names, reports, strict=True)
        ],
        **{
            key: [
                {**entry, "run": run}
                for run, report in zip(names, reports, strict=True)
                for entry in report.get(key) or []
            ]
            for key in ("left_out", "solves")
        },
        "results": results,
    }
