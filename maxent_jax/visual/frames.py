"""Draws episodes as pictures, each with its policy, its time, and a map of its path."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from maxent_jax.analysis import Paths, Run
from maxent_jax.density import histogram
from maxent_jax.visual import plotting
from maxent_jax.visual.rendering import Scene

MAP_SIDE = 0.27  # of the picture's side
MAP_PIXELS = 4  # drawn for each one shown, for smooth lines
MAP_OPACITY, GRID_OPACITY = 170, 110  # of 255
TEXT_HEIGHT = 0.035  # of the picture's side; 11 pixels at least
INK, PAPER = (25, 32, 40), (255, 255, 255)
FADE = 0.55  # of a picture after its episode's end, towards white
GAP = 4  # pixels of paper between the pictures of a mosaic


class Episode(NamedTuple):
    """An episode of one policy, up to its end."""

    name: str
    weight: float  # of the policy in the mixture
    color: tuple[int, int, int]
    states: np.ndarray  # [T, D]
    route: np.ndarray  # [T, 2] on the grid's axes


class Film(NamedTuple):
    """What all pictures of a run have in common."""

    scene: Scene
    axes: tuple[str, str]  # names of the map's axes
    low: np.ndarray  # [2] the map's corners; the map holds the grid and all episodes
    high: np.ndarray  # [2]
    grid: np.ndarray  # [2, 2] the grid's corners, low and high
    seconds: float  # per step
    speed: float | None  # of playback relative to the simulation; None: stills


def median_episodes(run: Run, paths: Paths) -> list[Episode]:
    """Returns one episode of each policy, the one of median length."""
    colors = (255 * plotting.policy_colors(run.num_policies)).astype(int)
    return [
        _episode(run, paths, policy, tuple(colors[policy, :3].tolist()))
        for policy in range(run.num_policies)
    ]


def _episode(run: Run, paths: Paths, policy: int, color: tuple[int, int, int]) -> Episode:
    played = np.flatnonzero(paths.policy == policy)
    lengths = paths.alive[played].sum(axis=1)
    chosen = played[np.argsort(lengths, kind="stable")[(len(played) - 1) // 2]]
    states = paths.states[chosen][: max(paths.alive[chosen].sum(), 1)]
    route = np.asarray(histogram.locate(states, run.components.grid))
    return Episode(f"π{policy}", float(run.weights[policy]), color, states, route)


def make(run: Run, scene: Scene, episodes: Sequence[Episode], speed: float | None) -> Film:
    """Makes the film of these episodes; its map is the grid, widened to hold them all."""
    grid = run.components.grid
    corners = np.array([grid.low, grid.high])
    center, half = corners.mean(axis=0), np.diff(corners, axis=0)[0] / 2
    farthest = max(np.abs((episode.route - center) / half).max() for episode in episodes)
    reach = 1.05 * max(farthest, 1.0) * half
    seconds = float(run.components.env.dt)
    return Film(scene, grid.names, center - reach, center + reach, corners, seconds, speed)


def picture(film: Film, episode: Episode, step: int) -> np.ndarray:
    """Draws an episode at a step, [size, size, 3] uint8; after its end, its last state, faded."""
    last = len(episode.states) - 1
    shown = min(step, last)
    image = Image.fromarray(film.scene.draw(episode.states[shown]))
    if step > last:
        image = Image.blend(image, Image.new("RGB", image.size, PAPER), FADE)
    _draw_map(image, film, episode, shown)
    _write(image, film, episode, step)
    return np.asarray(image)


def mosaic(pictures: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Arranges pictures [H, W, 3] in rows; the last row may end blank."""
    height, width = np.array(pictures[0].shape[:2]) + GAP
    num_rows = -(-len(pictures) // columns)
    sheet = np.full((num_rows * height, columns * width, 3), PAPER, np.uint8)
    for i, tile in enumerate(pictures):
        top, left = i // columns * height, i % columns * width
        sheet[top : top + height - GAP, left : left + width - GAP] = tile
    return sheet[:-GAP, :-GAP]


def stills(length: int, number: int) -> list[int]:
    """Returns `number` steps equally spaced in time, from the first to the last of `length`."""
    return np.linspace(0, length - 1, number).round().astype(int).tolist()


def _write(image: Image.Image, film: Film, episode: Episode, step: int) -> None:
    height = max(11, round(TEXT_HEIGHT * image.width))
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), height)
    margin = height // 2
    write = functools.partial(
        ImageDraw.Draw(image).text, font=font, fill=INK, stroke_width=2, stroke_fill=PAPER
    )
    last = len(episode.states) - 1
    shown = min(step, last)
    time = f"{(shown + 1) * film.seconds:.2f} s"
    above = f"{episode.name}  weight {episode.weight:.2f}\n"
    above += f"ended after {time}" if step > last else time
    above += f"  ×{film.speed:g}" if film.speed and step <= last else ""
    write((margin, margin), above)
    where = zip(film.axes, np.round(episode.route[shown], 1) + 0.0, strict=True)  # no "-0.0"
    below = "   ".join(f"{name} {value:.1f}" for name, value in where)
    write((margin, image.height - margin), below, anchor="ld")


def _draw_map(image: Image.Image, film: Film, episode: Episode, step: int) -> None:
    """In the upper right corner: the grid, the route so far, and its end."""
    side = round(MAP_SIDE * image.width)
    sheet = Image.new("RGBA", (side * MAP_PIXELS,) * 2, (*PAPER, MAP_OPACITY))
    draw = ImageDraw.Draw(sheet)
    locate = lambda points: (points - film.low) / (film.high - film.low) * sheet.width
    flip = lambda points: [(x, sheet.height - y) for x, y in locate(points).tolist()]
    (left, bottom), (right, top) = flip(film.grid)
    draw.rectangle((left, top, right, bottom), outline=(*INK, GRID_OPACITY), width=MAP_PIXELS)
    route = flip(episode.route[: step + 1])
    draw.line(route, fill=episode.color, width=2 * MAP_PIXELS)
    draw.circle(route[-1], 3 * MAP_PIXELS, fill=episode.color)
    small = sheet.resize((side, side), Image.Resampling.LANCZOS)
    margin = side // 16
    image.paste(small, (image.width - side - margin, margin), small)
