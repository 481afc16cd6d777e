"""Pictures of a lit mesh: exact ones by ray casting, fast ones by OpenGL.

Primary rays are traced once into :class:`PrimaryHits`, which shade any number of pictures: one
light or one representation after another costs an interpolation each. Radiance stays linear until
:func:`tone_map`; pictures that are compared share one exposure. Rows count downwards, columns to
the right, and a camera that looks along -z with +y up has +x at its right.
"""

from prt_torch.preview.camera import Camera
from prt_torch.preview.images import (
    ERROR_COLORMAP,
    automatic_exposure,
    difference_image,
    encode_png,
    error_colours,
    tone_map,
    write_exr,
    write_png,
)
from prt_torch.preview.opengl import render_opengl
from prt_torch.preview.rays import PrimaryHits, trace

__all__ = [
    "ERROR_COLORMAP",
    "Camera",
    "PrimaryHits",
    "automatic_exposure",
    "difference_image",
    "encode_png",
    "error_colours",
    "render_opengl",
    "tone_map",
    "trace",
    "write_exr",
    "write_png",
]
