"""Frames, film strips and videos of episodes."""

from __future__ import annotations

import base64
import html
import importlib
import io
import itertools
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v3 as iio
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from gymnasium import Env
from matplotlib.figure import Figure

from ipo.checks import Count, check_choice, checked
from ipo.worlds.door import DoorParams, build_door, shift_handle
from ipo.worlds.minigrid_tables import state_of
from ipo.worlds.tabular import TabularTask


def record(
    env: Env, act: Callable[[Any], Any], seed: int, max_frames: int = 60
) -> list[np.ndarray]:
    """Frames of one episode of ``act(observation) -> action``, the first one included."""
    observation, _ = env.reset(seed=seed)
    frames = [env.render()]
    while len(frames) < max_frames:
        observation, _, terminated, truncated, _ = env.step(act(observation))
        frames.append(env.render())
        if terminated or truncated:
            break
    return frames


def record_on_table(
    env: Env, table: TabularTask, act: Callable[[int, int], int], seed: int
) -> list[np.ndarray]:
    """:func:`record` of ``act(step, state) -> action``, where the table counts the states."""
    steps = itertools.count()
    return record(env, lambda _: int(act(next(steps), state_of(table, env))), seed)


def film_strip(
    rows: dict[str, Sequence[np.ndarray]], num_frames: int = 8, steps_per_frame: int = 1
) -> Figure:
    """Evenly spaced frames of several episodes, a row each, for readers of a printed page."""
    fig, axes = plt.subplots(
        len(rows), num_frames, figsize=(1.25 * num_frames, 1.4 * len(rows)), squeeze=False
    )
    for line, (title, frames) in zip(axes, rows.items(), strict=True):
        steps = np.linspace(0, len(frames) - 1, min(num_frames, len(frames))).round().astype(int)
        for ax in line:
            ax.axis("off")
        for ax, step in zip(line, steps, strict=False):
            ax.imshow(frames[step])
            ax.set_title(f"step {step * steps_per_frame}", fontsize="small")
        line[0].text(
            -0.12, 0.5, title, transform=line[0].transAxes, rotation=90, ha="center", va="center"
        )
    return fig


def titled(
    pictures: Sequence[tuple[str, np.ndarray]], num_rows: int, size: tuple[float, float]
) -> Figure:
    """Pictures with their titles, in rows of the same length."""
    fig, axes = plt.subplots(num_rows, -(-len(pictures) // num_rows), figsize=size, squeeze=False)
    for ax in axes.flat:
        ax.axis("off")
    for ax, (title, picture) in zip(axes.flat, pictures, strict=False):
        ax.imshow(picture)
        ax.set_title(title, fontsize="medium")
    return fig


def side_by_side(episodes: Sequence[Sequence[np.ndarray]], gap: int = 8) -> list[np.ndarray]:
    """One film of several: those that are over stand still on their last frame."""
    length = max(map(len, episodes))
    padded = [[*episode, *[episode[-1]] * (length - len(episode))] for episode in episodes]
    bar = np.full((episodes[0][0].shape[0], gap, 3), 255, np.uint8)
    return [
        np.concatenate([part for frame in frames for part in (frame, bar)][:-1], axis=1)
        for frames in zip(*padded, strict=True)
    ]


def film_address(frames: Sequence[np.ndarray], fps: float) -> str:
    """A film as the address of a video."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        iio.imwrite(path, _even(frames), fps=fps, codec="libx264", macro_block_size=2)
        return f"data:video/mp4;base64,{base64.b64encode(path.read_bytes()).decode()}"


def video(frames: Sequence[np.ndarray], caption: str, fps: int = 4) -> str:
    """HTML of a film inside the page: its last frame as poster, a strip for print, a caption."""
    even, text = _even(frames), html.escape(caption)
    return (
        f'<div class="film"><video controls loop muted playsinline aria-label="{text}" '
        f'width="100%" poster="{address(even[-1])}">'
        f'<source type="video/mp4" src="{film_address(frames, fps)}"></video>'
        f'<img class="strip" src="{address(strip(even))}" alt="Frames of the film: {text}">'
        f"<p>{text}</p></div>"
    )


def _even(frames: Sequence[np.ndarray]) -> np.ndarray:
    """Frames whose sides are even, as the codec wants them."""
    height, width, _ = frames[0].shape
    return np.stack([np.pad(f, ((0, height % 2), (0, width % 2), (0, 0)), "edge") for f in frames])


def strip(frames: Sequence[np.ndarray], width: int = 1400) -> np.ndarray:
    """Evenly spaced frames side by side, as many as fit, in half the size."""
    num_frames = max(2, width * 2 // frames[0].shape[1])
    chosen = np.linspace(0, len(frames) - 1, min(num_frames, len(frames))).round().astype(int)
    return side_by_side([[frames[step][::2, ::2]] for step in chosen])[0]


def address(picture: np.ndarray) -> str:
    """A picture as an address that has all of it; WebP, a fifth of PNG's size."""
    file = io.BytesIO()
    iio.imwrite(file, picture, extension=".webp", quality=80)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"


class DoorPicture:
    """Pictures of a door and the robot, drawn by MuJoCo without a display.

    The scene is a model of its own: frame, wall, floor, light and paint are not simulated, so
    that a door which is drawn moves like one that is not.

    Args:
        params: the door.
        width, height: of a picture, in pixels.
        camera: ``room`` shows the robot in front of the door, ``handle`` how it holds on.

    Raises:
        RenderError: no OpenGL without a display (EGL) on this machine.
    """

    @checked
    def __init__(
        self, params: DoorParams, width: Count = 640, height: Count = 480, camera: str = "room"
    ) -> None:
        check_choice("camera", camera, CAMERAS)
        self.params = params
        self.model = door_scene(params, width, height).compile()
        self.data = mujoco.MjData(self.model)
        self.rectangle = mujoco.MjrRect(0, 0, width, height)
        try:
            # Not by mujoco.Renderer, which uses EGL only where an environment variable had been
            # set before MuJoCo was imported.
            self.context = importlib.import_module("mujoco.egl").GLContext(width, height)
            self.context.make_current()
            self.opengl = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except Exception as error:  # MuJoCo, PyOpenGL and ctypes each raise their own
            raise RenderError(
                "doors cannot be drawn: OpenGL without a display (EGL) does not start. On Debian: "
                "sudo apt-get install libegl1 libgl1 libgl1-mesa-dri libegl-mesa0 "
                f"(the cause was: {error})"
            ) from error
        # Also where nobody closes it: MuJoCo's own clean-up would free what is another picture's.
        self.close = weakref.finalize(self, _free, self.context, self.opengl)
        self.close.atexit = False  # then MuJoCo has closed the display already
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.opengl)
        self.scene = mujoco.MjvScene(self.model, maxgeom=200)
        self.camera = mujoco.MjvCamera()
        self.about, self.camera.distance, self.camera.azimuth, self.camera.elevation = CAMERAS[
            camera
        ]
        self.follows = camera == "handle"

    def frame(self, qpos: np.ndarray, handle_shift: np.ndarray) -> np.ndarray:
        """A picture ``[height, width, 3]`` of the joints ``[7]``."""
        shift_handle(self.model, self.params, handle_shift)
        self.data.qpos[:] = qpos
        mujoco.mj_forward(self.model, self.data)
        center = self.data.body("handle").xpos if self.follows else self.params.position
        self.camera.lookat[:] = center + self.about
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self.model, self.data, mujoco.MjvOption(), None, self.camera, everything, self.scene
        )
        self.context.make_current()
        mujoco.mjr_render(self.rectangle, self.scene, self.opengl)
        picture = np.empty((self.rectangle.height, self.rectangle.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, None, self.rectangle, self.opengl)
        return picture[::-1]  # OpenGL counts lines from below


class RenderError(RuntimeError):
    """No pictures can be drawn on this machine."""


class Blank:
    """What stands where a door cannot be drawn."""

    def __init__(self, width: int, height: int) -> None:
        self.picture = np.full((height, width, 3), 220, np.uint8)

    def frame(self, *_: Any) -> np.ndarray:
        return self.picture


def camera(
    params: DoorParams, view: str = "handle", width: int = 240, height: int = 180
) -> DoorPicture | Blank:
    """Draws a door; without OpenGL, says what to install and goes on without pictures."""
    try:
        return DoorPicture(params, width, height, view)
    except RenderError as error:
        print(error)
        return Blank(width, height)


def _free(context: Any, opengl: mujoco.MjrContext) -> None:
    """Give the memory of OpenGL back: its numbers only mean something in their own context."""
    context.make_current()
    opengl.free()
    context.free()


def door_scene(params: DoorParams, width: int = 640, height: int = 480) -> mujoco.MjSpec:
    """:func:`ipo.worlds.door.build_door` with paint, light, frame, wall and floor, for pictures."""
    spec = build_door(params)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.quality.shadowsize, spec.visual.quality.offsamples = 1536, 8
    spec.visual.map.shadowclip = 0.3  # shadows of what is near, so that a small map is sharp
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.38] * 3, [0.25] * 3
    spec.visual.headlight.specular = [0.05] * 3
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 30
    for position, strength, shadow in (
        ((2.2, -1.6, 3.2), 0.55, True),
        ((1.5, 2.0, 2.2), 0.25, False),
    ):
        light = spec.worldbody.add_light(pos=position, castshadow=shadow)
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.dir = np.array([0.0, 0.0, 1.0]) - position
        light.diffuse, light.specular = [strength] * 3, [0.2 * shadow] * 3
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[0.93, 0.95, 0.97],
        width=16,
        height=96,
    )
    for name, (color, shininess, specular) in PAINTS.items():
        spec.add_material(name=name, rgba=[*color, 1], shininess=shininess, specular=specular)
    for geom in spec.geoms:
        geom.material = next(paint for part, paint in PAINTED.items() if geom.name.startswith(part))
    _add_surroundings(spec, params)
    return spec


# Colour, shininess and specular reflection.
PAINTS = {
    "wood": ((0.72, 0.53, 0.36), 0.2, 0.2),
    "steel": ((0.82, 0.83, 0.85), 0.8, 0.9),
    "hook": ((0.10, 0.12, 0.16), 0.6, 0.5),
    "robot": ((0.11, 0.39, 0.66), 0.5, 0.4),
    "frame": ((0.93, 0.92, 0.89), 0.1, 0.1),
    "wall": ((0.80, 0.83, 0.84), 0.0, 0.0),
    "floor": ((0.62, 0.60, 0.57), 0.1, 0.1),
}
PAINTED = {"panel": "wood", "handle": "steel", "hook": "hook", "wrist": "robot"}
# Point looked at, from the door's or the handle's position; distance; azimuth and elevation in
# degrees.
CAMERAS = {
    "room": (np.array([0.3, 0.2, 0.05]), 2.5, 140.0, -16.0),
    "handle": (np.array([0.1, 0.05, 0.0]), 0.6, 160.0, -50.0),
}
FRAME, WALL = 0.08, 3.0  # widths beside the door


def _add_surroundings(spec: mujoco.MjSpec, params: DoorParams) -> None:
    """What nothing collides with: a frame around the door, the wall, the floor."""
    left = params.wall_offset - params.width / 2
    right = params.wall_offset + params.width / 2
    top = params.height
    depth, behind = 0.06, 1.1 * params.thickness - params.thickness / 2
    boxes = [
        ("frame", (left - FRAME, left), (0, top + FRAME), behind + 0.02),
        ("frame", (right, right + FRAME), (0, top + FRAME), behind + 0.02),
        ("frame", (left, right), (top, top + FRAME), behind + 0.02),
        ("wall", (left - FRAME - WALL, left - FRAME), (0, top + FRAME), behind),
        ("wall", (right + FRAME, right + FRAME + WALL), (0, top + FRAME), behind),
        ("wall", (left - FRAME - WALL, right + FRAME + WALL), (top + FRAME, 4.0), behind),
    ]
    for number, (material, (y0, y1), (z0, z1), front) in enumerate(boxes):
        spec.worldbody.add_geom(
            name=f"{material}_{number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[depth / 2, (y1 - y0) / 2, (z1 - z0) / 2],
            pos=[front - depth / 2, (y0 + y1) / 2, (z0 + z1) / 2],
            material=material,
            contype=0,
            conaffinity=0,
        )
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[4, 4, 0.05],
        pos=[0, 0, -0.06],
        material="floor",
        contype=0,
        conaffinity=0,
    )
