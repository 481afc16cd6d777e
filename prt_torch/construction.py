"""Closed forms by the name of their kind, as runs and sweeps make them."""

from dataclasses import dataclass
from typing import Any

import torch

from prt_torch.metric import Metric
from prt_torch.representations import Representation
from prt_torch.representations.files import KINDS
from prt_torch.transfer import TransferTensor

_CPCA_COPIES = 8  # of the tensor, which a fit of CPCA without a budget takes at most

Parameters = dict[str, Any]
"""Keywords of a kind's ``from_transfer``, in plain JSON."""


@dataclass(frozen=True)
class Problem:
    """What closed forms start from.

    Attributes:
        transfer: The tensor to stand for.
        metric: What errors are worth; the L2 norm over light directions if not given.
        seed: Of every fit alike.
        memory_budget: Bytes that a fit may take.
    """

    transfer: TransferTensor
    metric: Metric | None = None
    seed: int = 0
    memory_budget: int = 4 * 2**30

    @property
    def known_metric(self) -> Metric:
        """The metric, L2 if none was given."""
        return self.metric or Metric.l2(self.transfer)


def closed_form(problem: Problem, kind: str, parameters: Parameters) -> Representation:
    """A representation as its paper constructs it.

    Raises:
        ValueError: If the transfer or a parameter does not suit the kind.
        InputError: If the fit would take more than the memory budget.
    """
    common: dict[str, Any] = {
        "metric": problem.metric,
        "generator": torch.Generator().manual_seed(problem.seed),
    }
    match kind:
        case "wavelet":  # terms by magnitude, as its paper chooses them
            common = {}
        case "segmented_cpca" | "clustered_tensor" | "scattered_srbf":
            common["memory_budget"] = problem.memory_budget
        case "cpca" if _CPCA_COPIES * problem.transfer.num_bytes > problem.memory_budget:
            common["memory_budget"] = problem.memory_budget  # in chunks: slower, the same result
    return KINDS[kind].from_transfer(problem.transfer, **parameters, **common)
