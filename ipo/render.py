"""Frames, film strips and videos of episodes."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import imageio.v3 as iio
import matplotlib.pyplot as plt
import numpy as np
from gymnasium import Env
from matplotlib.figure import Figure


def record(
    env: Env, act: Callable[[dict], int], seed: int, max_frames: int = 60
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


def film_strip(rows: dict[str, Sequence[np.ndarray]], num_frames: int = 8) -> Figure:
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
            ax.set_title(f"step {step}", fontsize=8)
        line[0].text(
            -0.12, 0.5, title, transform=line[0].transAxes, rotation=90, ha="center", va="center"
        )
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


def video(frames: Sequence[np.ndarray], caption: str, fps: int = 4) -> str:
    """HTML of a film inside the page, with its last frame as poster and a caption."""
    even = [np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), "edge") for f in frames]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        iio.imwrite(path, np.stack(even), fps=fps, codec="libx264", macro_block_size=2)
        film = base64.b64encode(path.read_bytes()).decode()
    picture = io.BytesIO()
    iio.imwrite(picture, even[-1], extension=".png")
    poster = base64.b64encode(picture.getvalue()).decode()
    text = html.escape(caption)
    return (
        f'<div class="film"><video controls loop muted playsinline aria-label="{text}" '
        f'width="100%" poster="data:image/png;base64,{poster}">'
        f'<source type="video/mp4" src="data:video/mp4;base64,{film}"></video>'
        f"<p>{text}</p></div>"
    )
