"""Compressed transfer: every representation, the contract they share, and their files."""

from prt_torch.representations.base import Representation
from prt_torch.representations.clustered_tensor import ClusteredTensor
from prt_torch.representations.cpca import CPCA
from prt_torch.representations.dense import DenseTransfer
from prt_torch.representations.files import load, save
from prt_torch.representations.scattered_srbf import ScatteredSRBF
from prt_torch.representations.segmented_cpca import SegmentedCPCA
from prt_torch.representations.wavelet import WaveletTransfer
from prt_torch.representations.zonal_lobes import ZonalLobes

__all__ = [
    "CPCA",
    "ClusteredTensor",
    "DenseTransfer",
    "Representation",
    "ScatteredSRBF",
    "SegmentedCPCA",
    "WaveletTransfer",
    "ZonalLobes",
    "load",
    "save",
]
