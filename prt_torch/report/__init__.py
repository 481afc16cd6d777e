"""What a run found, for eyes: a terminal table, trade-off plots, one self-contained HTML page.

Everything reads the run dictionary of ``report.json``; :func:`gather` joins several of them into
one that all functions here take as well. Values that are missing, NaN or infinite are shown as
missing, never as a number.
"""

from prt_torch.report.outcome import gather
from prt_torch.report.page import Picture, write_html
from prt_torch.report.plots import error_against_bytes, error_against_time
from prt_torch.report.summary import solves_table, summary_table

__all__ = [
    "Picture",
    "error_against_bytes",
    "error_against_time",
    "gather",
    "solves_table",
    "summary_table",
    "write_html",
]
