"""The fast picture: pyrender on EGL, left out with one logged line where it cannot run."""

import logging
import os
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from prt_torch.assets.environment import Environment
from prt_torch.assets.mesh import Mesh
from prt_torch.preview.camera import Camera, in_unit_box
from prt_torch.preview.images import to_bytes, tone_map

_logger = logging.getLogger(__name__)


def render_opengl(
    mesh: Mesh,
    radiance: Float[Tensor, "points rgb"],
    camera: Camera,
    width: int,
    height: int,
    background: Environment | None = None,
    *,
    exposure: float,
) -> UInt8[np.ndarray, "height width rgb"] | None:
    """The fast preview: the same picture through pyrender and EGL, tone-mapped at the vertices.

    Args:
        mesh: The scene; faces are seen from both sides.
        radiance: Outgoing linear radiance of each vertex towards the camera.
        camera: Where from.
        width: Pixels in a row.
        height: Rows.
        background: What is seen beside the mesh; black if None.
        exposure: Factor on radiance before the display curve, as for :func:`tone_map`.

    Returns:
        The picture as 8-bit sRGB; None, with the reason logged, where OpenGL cannot be used.
    """
    colours = tone_map(radiance.detach().float().cpu().numpy(), exposure).astype(np.float32) / 255
    try:
        rendered = _render_premultiplied(mesh, colours, camera, width, height)
    # Missing libraries, drivers and displays surface as anything from AttributeError to GLError.
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        _logger.warning("OpenGL preview left out: %s", reason)
        return None
    if background is None:
        return rendered[..., :3].copy()
    directions = torch.from_numpy(camera.directions(width, height)[:, :, 0])
    behind = tone_map(background.radiance(directions).detach().float().cpu().numpy(), exposure)
    uncovered = 1 - rendered[..., 3:] / 255.0
    return to_bytes((rendered[..., :3] + uncovered * behind) / 255.0)


def _render_premultiplied(
    mesh: Mesh,
    colours: Float32[np.ndarray, "points rgb"],
    camera: Camera,
    width: int,
    height: int,
) -> UInt8[np.ndarray, "height width rgba"]:
    # Both are read when the packages are first imported, and choose a context without a display.
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    os.environ.setdefault("PYGLET_HEADLESS", "true")
    import pyrender

    vertices, eye = in_unit_box(mesh, camera)
    primitive = pyrender.Primitive(
        positions=vertices, indices=mesh.faces.numpy(), color_0=colours, mode=4
    )
    model: Any = pyrender.Mesh([primitive])
    model._bounds = np.stack([vertices.min(0), vertices.max(0)])  # computing it needs NumPy 1
    scene = pyrender.Scene(bg_color=np.zeros(4))
    scene.add(model)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.axes().T, eye
    farthest = float(np.linalg.norm(vertices - eye, axis=1).max())
    scene.add(
        pyrender.PerspectiveCamera(
            yfov=np.radians(camera.vertical_fov_degrees), znear=1e-3 * farthest, zfar=2 * farthest
        ),
        pose=pose,
    )
    flags = pyrender.RenderFlags.FLAT | pyrender.RenderFlags.SKIP_CULL_FACES
    renderer = pyrender.OffscreenRenderer(width, height)
    try:
        rendered: Any = renderer.render(scene, flags=flags | pyrender.RenderFlags.RGBA)
    finally:
        renderer.delete()
    return rendered[0]
