"""Renderer of the camera: Panda3D's software rasteriser, which needs no display and no graphics card.

Light is static and computed into the vertex colours when a mesh is added. Meshes outside the field of view are skipped,
so a large scene should be added in pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan, degrees, log2, tan
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from panda3d import core

from sim_hil.world.drawing.mesh import MeshBuilder, Surface
from sim_hil.world.drawing.stage import Quaternion, Vec3
from sim_hil.world.drawing.textures import Image

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

NEAR_M: Final = 0.03  # near plane; small, because the robot's nose may touch a wall
# Far away: the rasteriser interpolates textures by depth-buffer values, which bends them where the far plane is near.
FAR_M: Final = 10_000.0
_SUN: Final = np.array((-3.0, 2.0, 6.0)) / 7.0  # direction of the light source
_AMBIENT, _DIFFUSE = 0.72, 0.36
_MAX_TEXTURE_PX: Final = 512
_SAMPLES: Final = 2  # each way: smooth edges keep far things recognisable
_SAMPLED_PX: Final = 640 * 360  # larger images are drawn without supersampling

core.load_prc_file_data(
    "sim_hil",
    "load-display p3tinydisplay\nwindow-type offscreen\naudio-library-name null\nnotify-level error\n"
    # Poses change in every frame, so caching values derived from them costs more than recomputing.
    "transform-cache 0\ngarbage-collect-states 0\n",
)


class RendererError(RuntimeError):
    """The software rasteriser did not start."""


class Renderer:
    """Stage that renders images; `sky`: background, RGB 0..1. Not thread-safe.

    `smooth`: antialiased edges; without it every pixel has the colour of one object.
    """

    def __init__(self, sky: Vec3, *, smooth: bool = True) -> None:
        self._samples = _SAMPLES if smooth else 1
        self._pipe = core.GraphicsPipeSelection.get_global_ptr().make_pipe("TinyOffscreenGraphicsPipe")
        if self._pipe is None or not self._pipe.is_valid():
            raise RendererError(
                "camera: Panda3D's software rasteriser did not load: expected the module p3tinydisplay and the system's"
                " libX11.so.6; install the package libx11-6 (Debian, Ubuntu) or libX11 (Fedora)"
            )
        self._engine = core.GraphicsEngine(self._pipe)
        self._sky = sky
        self._root = core.NodePath("scene")
        # Drawn in the order of the scene graph: the same picture in every process, also where two surfaces coincide.
        self._root.set_bin("unsorted", 0)
        self._nodes: list[core.NodePath] = []
        self._textures: dict[int, tuple[Image, core.Texture]] = {}
        self._lens = core.PerspectiveLens()
        self._camera = self._root.attach_new_node(core.Camera("camera", self._lens))
        self._arranged: list[int] = []
        self._views: dict[tuple[int, int], tuple[core.GraphicsOutput, core.Texture]] = {}

    def add(self, mesh: MeshBuilder) -> int:
        """Show a mesh as it was built, and return its handle."""
        node = core.GeomNode("mesh")
        for surface in mesh.surfaces():
            state = core.RenderState.make_empty()
            if surface.image is not None:
                state = core.RenderState.make(core.TextureAttrib.make(self._texture(surface.image)))
            node.add_geom(_geom(surface), state)
        self._nodes.append(self._root.attach_new_node(node))
        return len(self._nodes) - 1

    def place(self, handle: int, position_m: Vec3, quaternion_xyzw: Quaternion) -> None:
        """Set a mesh's pose; shows it again if it was hidden."""
        node = self._nodes[handle]
        x, y, z, w = quaternion_xyzw
        node.set_pos_quat(core.LPoint3(*position_m), core.LQuaternion(w, x, y, z))
        if node.is_stashed():
            node.unstash()

    def hide(self, handle: int) -> None:
        """Hide a mesh until it is placed again."""
        self._nodes[handle].stash()

    def arrange(self, fixed: Sequence[int], shown: Sequence[int]) -> None:
        """Show only these of the meshes `fixed`, drawn in this order; nearest first avoids overdraw."""
        if list(shown) == self._arranged:
            return
        for handle in self._arranged or fixed:
            self._nodes[handle].detach_node()
        for place, handle in enumerate(shown):
            self._nodes[handle].reparent_to(self._root, place - len(fixed))
        self._arranged = list(shown)

    def picture(
        self, eye_m: Array, forward: Array, up: Array, hfov_rad: float, width: int, height: int, aspect: float
    ) -> Picture:
        """Render the view from `eye_m` along `forward`, uint8 RGB [height, width, 3].

        `hfov_rad`: horizontal field of view; `aspect`: aspect ratio of the view, which may differ from the image's.
        """
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        ahead = forward / np.linalg.norm(forward)
        above = np.cross(right, ahead)
        rows = [(*right, 0.0), (*ahead, 0.0), (*above, 0.0), (*eye_m, 1.0)]
        self._camera.set_mat(core.LMatrix4(*(float(value) for row in rows for value in row)))
        self._lens.set_fov(degrees(hfov_rad), degrees(2 * atan(tan(hfov_rad / 2) / aspect)))
        self._lens.set_near_far(NEAR_M, FAR_M)
        samples = self._samples if width * height <= _SAMPLED_PX else 1
        drawn = self._draw(width * samples, height * samples)
        if samples > 1:
            drawn = np.asarray(cv2.resize(drawn, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        return np.asarray(cv2.flip(cv2.cvtColor(drawn, cv2.COLOR_BGRA2RGB), 0), np.uint8)

    def close(self) -> None:
        """Release everything; may be called twice."""
        self._engine.remove_all_windows()
        self._views.clear()
        self._nodes.clear()
        self._textures.clear()
        self._root.remove_node()

    def _draw(self, width: int, height: int) -> Picture:
        """Return the image as BGRA, bottom row first, in memory that the next image overwrites."""
        view = self._views.get((width, height))
        if view is None:
            view = self._views[width, height] = self._view(width, height)
        output, texture = view
        output.set_active(True)
        self._engine.render_frame()
        output.set_active(False)  # the engine draws every active view in each frame
        return np.frombuffer(texture.get_ram_image(), np.uint8).reshape(height, width, 4)

    def _view(self, width: int, height: int) -> tuple[core.GraphicsOutput, core.Texture]:
        pixels = core.FrameBufferProperties()
        pixels.set_rgba_bits(8, 8, 8, 8)
        pixels.set_depth_bits(20)
        size = core.WindowProperties.size(width, height)
        output = self._engine.make_output(
            self._pipe, f"{width}x{height}", 0, pixels, size, core.GraphicsPipe.BF_refuse_window
        )
        if output is None:
            raise RendererError(f"camera: no picture of {width} x {height} pixels could be made")
        output.set_clear_color((*self._sky, 1.0))
        output.make_display_region().set_camera(self._camera)
        texture = core.Texture()
        output.add_render_texture(texture, core.GraphicsOutput.RTM_copy_ram)
        return output, texture

    def _texture(self, image: Image) -> core.Texture:
        if id(image) in self._textures:
            return self._textures[id(image)][1]
        height, width = (_power_of_two(size) for size in image.shape[:2])
        fitted = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        texture = core.Texture()
        texture.setup_2d_texture(width, height, core.Texture.T_unsigned_byte, core.Texture.F_rgb)
        texture.set_ram_image(fitted[::-1, :, ::-1].tobytes())
        texture.set_wrap_u(core.SamplerState.WM_repeat)
        texture.set_wrap_v(core.SamplerState.WM_repeat)
        texture.set_minfilter(core.SamplerState.FT_linear_mipmap_linear)
        texture.set_magfilter(core.SamplerState.FT_linear)
        self._textures[id(image)] = (image, texture)  # the picture is kept, so that its id stays its own
        return texture


def _power_of_two(size: int) -> int:
    """Return the nearest size that the rasteriser supports."""
    return int(min(2 ** max(round(log2(size)), 3), _MAX_TEXTURE_PX))


def _geom(surface: Surface) -> core.Geom:
    vertices, indices, uvs, normals = surface.arrays()
    light = np.minimum(_AMBIENT + _DIFFUSE * np.maximum(normals @ _SUN, 0.0), 1.0)
    colours = np.array(surface.colours, np.float32) if surface.image is None else np.full((len(vertices), 3), 255.0)
    layout = [("position", "<f4", 3), ("colour", "u1", 4), ("uv", "<f4", 2)]
    rows = np.zeros(len(vertices), dtype=layout)
    rows["position"], rows["uv"] = vertices, uvs
    rows["colour"][:, :3], rows["colour"][:, 3] = colours * light[:, None], 255
    data = core.GeomVertexData("", core.GeomVertexFormat.get_v3c4t2(), core.Geom.UH_static)
    data.unclean_set_num_rows(len(rows))
    memoryview(data.modify_array(0)).cast("B")[:] = rows.tobytes()
    triangles = core.GeomTriangles(core.Geom.UH_static)
    triangles.set_index_type(core.Geom.NT_uint32)
    held = triangles.modify_vertices()
    held.unclean_set_num_rows(len(indices))
    memoryview(held).cast("B")[:] = indices.tobytes()
    geom = core.Geom(data)
    geom.add_primitive(triangles)
    return geom
