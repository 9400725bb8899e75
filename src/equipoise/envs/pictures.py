"""Rendering of an environment: to arrays, or in a window of MuJoCo's viewer."""

import os
import sys
import time
from collections.abc import Iterator
from importlib import import_module
from itertools import count
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.apps.report.pictures.camera import Size
from equipoise.apps.report.pictures.rendering import Picture, draw
from equipoise.apps.report.pictures.scene import stage
from equipoise.errors import OutsideError
from equipoise.model.arms.arm import Arm
from equipoise.model.physics_engine import mujoco

Array = npt.NDArray[np.float64]

SIZE: Final[Size] = 640, 480
"""Width and height of a picture [px]."""


class Screen:
    """Renderer of one environment."""

    def __init__(self, arm: Arm, mode: str) -> None:
        """Prepare the scene of an arm; `mode` is `rgb_array` or `human`."""
        self._scene, self._human = stage(arm, SIZE), mode == "human"
        self._q, self._phi, self._u = np.zeros(len(arm.joints)), 0.0, 0.0
        self._pictures: Iterator[Picture] | None = None
        self._viewer: Any = None
        self._data: Any = None
        self._offset = 0.0

    def show(self, q: Array, phi: float, u: float, now: float) -> Picture | None:
        """Show the rig, and return the picture in the mode `rgb_array`.

        Args:
            q: All joints [rad].
            phi: Angle of the pendulum from upright [rad].
            u: Commanded acceleration, shown as an arrow [m/s^2].
            now: Time since the release [s]; a window waits until that time has passed.

        Raises:
            OutsideError: OpenGL or a display is not available.
        """
        self._q, self._phi, self._u = q, phi, u
        if self._human:
            self._show_in_window(now)
            return None
        if self._pictures is None:
            # The generators return the current state at each request for a picture.
            q_now, phi_now = (self._q for _ in count()), (self._phi for _ in count())
            self._pictures = draw(self._scene, q_now, phi_now, (self._u for _ in count()))
        return next(self._pictures)

    def close(self) -> None:
        """Close the window, or free the OpenGL context."""
        if self._viewer is not None:
            self._viewer.close()
        if self._pictures is not None:
            self._pictures.close()  # pyright: ignore[reportAttributeAccessIssue]  # a generator
        self._viewer = self._pictures = None

    def _show_in_window(self, now: float) -> None:
        if self._viewer is None:
            self._viewer = self._open()
        if now == 0.0:
            self._offset = time.monotonic()
        self._data.qpos[:] = [*self._q, self._phi]
        mujoco().mj_forward(self._scene.model, self._data)
        self._viewer.sync()
        time.sleep(max(self._offset + now - time.monotonic(), 0.0))

    def _open(self) -> Any:
        screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if sys.platform.startswith("linux") and not screen:
            raise OutsideError(
                "there is no display for render_mode='human'; set DISPLAY, or use 'rgb_array'"
            )
        self._data = mujoco().MjData(self._scene.model)
        try:
            return import_module("mujoco.viewer").launch_passive(
                self._scene.model, self._data, show_left_ui=False, show_right_ui=False
            )
        except Exception as error:  # each display fails in its own way
            raise OutsideError(
                f"no window for render_mode='human' ({error}); use 'rgb_array'"
            ) from None
