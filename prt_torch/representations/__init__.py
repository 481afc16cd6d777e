"""Compressed transfer: every representation, the contract they share, and their files."""

from prt_torch.representations.base import Representation
from prt_torch.representations.clustered_tensor import ClusteredTensor
from prt_torch.representations.cpca import CPCA
from prt_torch.representations.dense import DenseTransfer
from prt_torch.representations.files import load, save
from prt_torch.representations.lobe_texture import LobeTexture
from prt_torch.representations.scattered_srbf import ScatteredSRBF
from prt_torch.representations.segmented_cpca import SegmentedCPCA
from prt_torch.representations.texture_map import TexelGrid
from prt_torch.representations.thin_membrane import (
    membrane_texture,
    thin_membrane,
    towards_viewer,
)
from prt_torch.representations.undetermined import undetermined
from prt_torch.representations.wavelet import WaveletTransfer
from prt_torch.representations.wrinkle import WrinkleMap, wrinkle_texture
from prt_torch.representations.zonal_lobes import ZonalLobes

__all__ = [
    "CPCA",
    "ClusteredTensor",
    "DenseTransfer",
    "LobeTexture",
    "Representation",
    "ScatteredSRBF",
    "SegmentedCPCA",
    "TexelGrid",
    "WaveletTransfer",
    "WrinkleMap",
    "ZonalLobes",
    "load",
    "membrane_texture",
    "save",
    "thin_membrane",
    "towards_viewer",
    "undetermined",
    "wrinkle_texture",
]
