"""Fitted representations as files.

A file holds exactly what ``packed()`` gives, the reflectance (``palette``), and in its header the
shape, the bases and the kind. Beside it stands ``<name>.sha256`` in the format of the ``sha256sum``
tool; loading verifies it. Saving and loading are exact to the bit.
"""

from pathlib import Path

from prt_torch import store
from prt_torch.bases import exit_basis, light_basis
from prt_torch.errors import InputError
from prt_torch.representations.base import Representation
from prt_torch.representations.clustered_tensor import ClusteredTensor
from prt_torch.representations.cpca import CPCA
from prt_torch.representations.dense import DenseTransfer
from prt_torch.representations.palette import packed_reflectance, take_reflectance
from prt_torch.representations.scattered_srbf import ScatteredSRBF
from prt_torch.representations.segmented_cpca import SegmentedCPCA
from prt_torch.representations.wavelet import WaveletTransfer
from prt_torch.representations.zonal_lobes import ZonalLobes
from prt_torch.transfer import Surface

KINDS: dict[str, type[Representation]] = {
    kind.kind: kind
    for kind in (
        CPCA,
        ClusteredTensor,
        DenseTransfer,
        ScatteredSRBF,
        SegmentedCPCA,
        WaveletTransfer,
        ZonalLobes,
    )
}
"""The closed registry of representations: name in configurations and files, to class."""

_EXIT = "exit."  # before the names of the tensors of the exit basis


def save(representation: Representation, path: Path | str) -> None:
    """Write a representation to ``path`` and its SHA-256 beside it, atomically.

    Raises:
        InputError: If the folder cannot be written.
    """
    path = Path(path)
    surface = representation.surface
    header = {
        "kind": representation.kind,
        "shape": list(representation.shape),
        "light_basis": surface.light_basis.describe() if surface.light_basis else None,
        "exit_basis": surface.exit_basis.describe(),
    }
    tensors = {**representation.packed(), **packed_reflectance(surface.reflectance)}
    tensors |= {_EXIT + name: tensor for name, tensor in surface.exit_basis.tensors().items()}
    written = store.write_tensors(path, tensors, header)
    store.write_bytes(checksum_path(path), f"{written['sha256']}  {path.name}\n".encode())


def load(path: Path | str, *, geometry: Surface | None = None) -> Representation:
    """Read what :func:`save` wrote.

    Args:
        path: The file.
        geometry: Where shading frames and positions come from, which belong to the mesh and are in
            no file: the surface of the transfer, say. Views of glossy transfer need them.

    Raises:
        InputError: If the file or its checksum is missing, damaged, or of an unknown kind.
    """
    path = Path(path)
    try:
        sha256 = checksum_path(path).read_text().split()[0]
    except (OSError, IndexError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: its checksum file {checksum_path(path).name} is missing or damaged"
        ) from error
    tensors, header = store.read_tensors(path, sha256)
    kind = header.get("kind") if isinstance(header, dict) else None
    if kind not in KINDS:
        raise InputError(f"{path}: expected a representation of {sorted(KINDS)}, got {kind!r}")
    of_exit = {
        name.removeprefix(_EXIT): tensors.pop(name)
        for name in list(tensors)
        if name.startswith(_EXIT)
    }
    points, channels, rows, coeffs = header["shape"]
    surface = Surface(
        exit_basis=exit_basis(header["exit_basis"], of_exit),
        light_basis=light_basis(header["light_basis"]) if header["light_basis"] else None,
        reflectance=take_reflectance(tensors, points),
        frames=geometry.frames if geometry else None,
        positions=geometry.positions if geometry else None,
    )
    return KINDS[kind].from_packed(tensors, surface, (points, channels, rows, coeffs))


def checksum_path(path: Path) -> Path:
    """Where the SHA-256 of a file stands."""
    return path.with_name(path.name + ".sha256")
