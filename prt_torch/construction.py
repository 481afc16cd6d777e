"""Closed forms by the name of their kind, as runs and sweeps make them."""

from dataclasses import dataclass
from typing import Any

import torch

from prt_torch.metric import Metric
from prt_torch.representations import CPCA, ClusteredTensor, Representation, ZonalLobes
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


SHARE = "quantisation_share"
"""Of the error, that codes may add: a parameter of several kinds."""

NO_CODES: dict[str, Parameters] = {
    "cpca": {SHARE: None},
    "segmented_cpca": {SHARE: 0.0},
    "clustered_tensor": {SHARE: None, "bits": None},
    "scattered_srbf": {"bits": None},
    "zonal_lobes": {SHARE: None, "bits": None},
    "wavelet": {"codes": "float"},
}
"""What keeps numbers as they are; those whose share is then None can be put in compressed codes."""


def before_codes(kind: str, parameters: Parameters) -> Parameters:
    """Parameters of the closed form whose numbers these compress; the same if they do not."""
    plain = NO_CODES.get(kind, {})
    compressed = plain.get(SHARE, 0.0) is None and parameters.get(SHARE) is not None
    return {**parameters, **plain} if compressed else parameters


def in_codes(problem: Problem, model: Representation, parameters: Parameters) -> Representation:
    """A closed form of :func:`before_codes` in compressed codes: that of these parameters.

    Raises:
        ValueError: If the kind cannot be compressed.
    """
    if not isinstance(model, CPCA | ClusteredTensor | ZonalLobes):
        raise ValueError(f"expected numbers that can be compressed, got {model.kind}")
    return model.coded(problem.transfer, share=parameters[SHARE], metric=problem.metric)
