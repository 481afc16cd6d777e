"""Sweeps: many representations of one bake, made chain by chain, judged alike, set side by side.

``settings`` says what may be asked for, ``workers`` who does it, ``chain`` what one job is,
``measure`` what a result is worth, ``waterfall`` and ``pictures`` what the report shows beside
figures; ``execution`` does all of it in order.
"""

from prt_torch.sweep.execution import execute, planned
from prt_torch.sweep.settings import SweepRun, parse_sweep

__all__ = ["SweepRun", "execute", "parse_sweep", "planned"]
