"""MuJoCo as the renderer: colour, depth and geom numbers of a scene at any time from any pose, without a display."""

from __future__ import annotations

import ctypes.util
import math
import os
import sys
from types import ModuleType, TracebackType
from typing import Any

import numpy as np

from improvo.errors import InputError, first_line, imported
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import rigid
from improvo.simulation.scene import Scene
from improvo.types import Float32, Float64, Int64, UInt8

_NEAR, _FAR = 0.05, 25.0  # metres
_OPTIONS = """
<option/><compiler angle="radian"/><statistic extent="1" center="0 0 1"/>
<visual>
  <map znear="{near}" zfar="{far}" shadowclip="1"/>
  <quality shadowsize="1024" offsamples="4" numslices="24" numstacks="12"/>
  <headlight ambient="0.52 0.52 0.53" diffuse="0 0 0" specular="0 0 0"/>
  <global offwidth="{width}" offheight="{height}"/>
</visual>"""


def camera_of(width: int, height: int, fov: float) -> Camera:
    """The pinhole camera of a symmetric frustum: the principal point is the middle of the image."""
    focal = width / 2 / math.tan(math.radians(fov) / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


class SceneRenderer:
    """Renders one scene; use it as a context manager.

    Raises:
        MissingExtraError: MuJoCo is not installed.
        InputError: it finds no way to draw without a display.
    """

    def __init__(self, scene: Scene, camera: Camera) -> None:
        self._mujoco = _import_mujoco()
        mujoco = self._mujoco
        self.camera = camera
        options = _OPTIONS.format(near=_NEAR, far=_FAR, width=camera.width, height=camera.height)
        xml = scene.builder.xml().replace("<mujoco>", f"<mujoco>{options}", 1)
        self._model: Any = mujoco.MjModel.from_xml_string(xml, scene.builder.assets)
        self._data: Any = mujoco.MjData(self._model)
        model = self._model
        try:
            self._renderer: Any = mujoco.Renderer(model, camera.height, camera.width, max_geom=model.ngeom + 100)
        except (RuntimeError, AttributeError, ImportError, mujoco.FatalError) as error:
            raise _no_display(error) from None
        for flag in (mujoco.mjtRndFlag.mjRND_SKYBOX, mujoco.mjtRndFlag.mjRND_HAZE, mujoco.mjtRndFlag.mjRND_FOG):
            self._renderer.scene.flags[flag] = 0
        self._specular = model.mat_specular.copy()
        self._motions = [(model.joint(m.joint).qposadr[0], m.position) for m in scene.builder.motions]
        names = [model.geom(i).name for i in range(model.ngeom)]
        self.moving = np.array([name in scene.builder.moving for name in names], bool)
        self.repeated = np.array([name in scene.builder.repeated for name in names], bool)

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._renderer.close()

    def image(self, time: float, world_from_cam: Float64, specular: bool = True, shadows: bool = True) -> UInt8:
        """Colours (H, W, 3) RGB of a perfect camera; highlights and cast shadows can be left out."""
        mujoco = self._mujoco
        self._model.mat_specular[:] = self._specular if specular else 0.0
        self._set(time, world_from_cam)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = int(shadows)
        return np.asarray(self._renderer.render())

    def geometry(self, time: float, world_from_cam: Float64) -> tuple[Float32, Int64]:
        """Depth Z (H, W) in metres, NaN beyond the scene, and geom numbers (H, W), -1 there."""
        self._set(time, world_from_cam)
        self._renderer.enable_depth_rendering()
        depth = np.asarray(self._renderer.render()).astype(np.float32)
        self._renderer.enable_segmentation_rendering()
        geom = np.asarray(self._renderer.render())[..., 0].astype(np.int64)
        self._renderer.disable_segmentation_rendering()
        return np.where(geom < 0, np.float32(np.nan), depth), geom

    def geom_poses(self, time: float) -> Float64:
        """world_from_geom (G, 4, 4)."""
        self._move(time)
        return rigid(self._data.geom_xmat.reshape(-1, 3, 3).copy(), self._data.geom_xpos.copy())

    def _move(self, time: float) -> None:
        for address, position in self._motions:
            self._data.qpos[address] = position(time)
        self._mujoco.mj_kinematics(self._model, self._data)
        self._mujoco.mj_comPos(self._model, self._data)
        self._mujoco.mj_camlight(self._model, self._data)

    def _set(self, time: float, world_from_cam: Float64) -> None:
        self._move(time)
        self._renderer.update_scene(self._data)
        half_height = _NEAR * self.camera.height / 2 / self.camera.fy
        for view in self._renderer.scene.camera:
            view.pos[:] = world_from_cam[:3, 3]
            view.forward[:] = world_from_cam[:3, 2]
            view.up[:] = -world_from_cam[:3, 1]
            view.frustum_near, view.frustum_far = _NEAR, _FAR
            view.frustum_bottom, view.frustum_top = -half_height, half_height
            view.frustum_center, view.frustum_width = 0.0, 0.0


def _import_mujoco() -> ModuleType:
    if sys.platform == "linux" and "MUJOCO_GL" not in os.environ and "DISPLAY" not in os.environ:
        os.environ["MUJOCO_GL"] = "osmesa" if ctypes.util.find_library("OSMesa") else "egl"
    os.environ.setdefault("MESA_SHADER_CACHE_DISABLE", "true")  # in a folder of the user that is none of our business
    try:
        mujoco: ModuleType = imported("mujoco", "simulate", "simulate")
    except (AttributeError, RuntimeError, OSError) as error:
        raise _no_display(error) from None
    return mujoco


def _no_display(error: Exception) -> InputError:
    return InputError(
        f"simulate: no OpenGL without a display ({first_line(error)}); "
        "install libosmesa6, or set MUJOCO_GL=egl with a driver"
    )
