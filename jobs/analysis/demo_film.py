"""The film of a recorded episode: camera, events, latent, actions, and the trajectory from above."""

import functools
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from core.pictures import grey_picture
from jobs.analysis.colours import COLOURS, INK
from jobs.analysis.ground_plan import ground_plan
from jobs.analysis.video import Decode, coloured, open_film, signs
from jobs.rollout.episodes import outcome_of
from jobs.rollout.recorded import Moment, RecordedEpisode

WIDTH, SIDE, GAP, HEAD, LINE = 1248, 320, 16, 44, 26  # pixels
MARGIN_M, SIDES_M = 2.0, 14.0  # shown before start and behind goal; on both sides of the trajectory
TOP = HEAD + LINE + SIDE + LINE + GAP // 2  # top of the plan
SLOWER, MAX_FPS, MIN_FPS = 4, 50, 10
FRAMES_PER_FLIGHT_S = 100  # at most; more take longer to draw and show no more
HEADINGS = (("left", 1), ("forward", 0), ("right", 2))  # actions from left to right, with their numbers
TEXT, DIM, WALL, TRAIL, CHOSEN = "#f1f5f9", "#94a3b8", "#64748b", "#38bdf8", "#f59e0b"
GROUND, OBSTACLE, GOAL = "#15181f", "#cbd5e1", "#34d399"
FONT, SMALL = ImageFont.load_default(18), ImageFont.load_default(15)
Font = ImageFont.FreeTypeFont | ImageFont.ImageFont
Box = tuple[int, int, int, int]  # left, top, width, height


@functools.lru_cache(maxsize=1024)  # most texts of a film are the same in every frame
def _written(text: str, font: Font, anchor: str) -> tuple[Image.Image, int, int]:
    """Return a text as a mask, and the offsets of the mask's left and top from the anchor [pixels]."""
    left, top, right, bottom = (round(edge) for edge in font.getbbox(text, anchor=anchor))
    mask = Image.new("L", (right - left, bottom - top))
    ImageDraw.Draw(mask).text((-left, -top), text, 255, font, anchor)
    return mask, left, top


def _write(
    picture: Image.Image,
    at: tuple[float, float],
    text: str,
    colour: str,
    font: Font,
    anchor: str,
) -> None:
    """Write a text on a picture, at the same place as Pillow's `ImageDraw.text`."""
    mask, left, top = _written(text, font, anchor)
    picture.paste(colour, (round(at[0]) + left, round(at[1]) + top), mask)


def write_film(path: Path, recorded: RecordedEpisode, title: str, decode: Decode | None) -> Path:
    """Write an MP4 file of an episode, with a frame for every step or every n-th step; return the file.

    Args:
        path: The file.
        recorded: The episode.
        title: Text at the top.
        decode: Event window -> picture in [-1, 1], float (H, W), for an additional panel; None: no panel.
    """
    control_hz, last = recorded.env.control_hz, len(recorded.moments) - 1
    stride = max(1, round(control_hz / FRAMES_PER_FLIGHT_S))
    fps = float(np.clip(round(control_hz / stride / SLOWER), MIN_FPS, MAX_FPS))
    canvas = _background(recorded, f"{title}   {_pace(control_hz / stride / fps)}")
    latents = [moment.latent for moment in recorded.moments if moment.latent is not None]
    largest = float(np.abs(latents).max(initial=0.0)) or 1.0
    with open_film(path, control_hz, None, fps) as film:
        before = 0
        for place in sorted({*range(0, last, stride), last}):
            film.add(np.asarray(_frame(canvas, recorded, (before, place), (decode, largest))))
            before = place
    return path


def _pace(slower: float) -> str:
    return f"{slower:.0f}x slower than real time" if slower >= 1.5 else "in real time"


def _scale(recorded: RecordedEpisode) -> float:
    """Return the scale of the plan [pixels/m]."""
    return WIDTH / (recorded.scene.length_m + 2 * MARGIN_M)


def _shown_m(recorded: RecordedEpisode) -> tuple[float, float]:
    """Return the range of x on the plan [m]: `SIDES_M` around the trajectory, at most up to the walls."""
    x_m = [moment.x_m for moment in recorded.moments]
    wall_m = 0.5 * recorded.scene.width_m + MARGIN_M
    return max(-wall_m, min(x_m) - SIDES_M), min(wall_m, max(x_m) + SIDES_M)


def _on_plan(recorded: RecordedEpisode, xy_m: np.ndarray) -> list[tuple[float, float]]:
    """Return the pixels of points (N, 2) [m] on the plan: forward is right, right is down."""
    scale, (first_m, _) = _scale(recorded), _shown_m(recorded)
    x_m, y_m = np.atleast_2d(xy_m).T
    across, down = (y_m + MARGIN_M) * scale, TOP + (x_m - first_m) * scale
    return list(zip(across.tolist(), down.tolist(), strict=True))


def _background(recorded: RecordedEpisode, title: str) -> Image.Image:
    """Draw the constant part of the film: the corridor from above, and the title."""
    scene, (first_m, last_m) = recorded.scene, _shown_m(recorded)
    height = int(TOP + (last_m - first_m) * _scale(recorded))
    picture = Image.new("RGB", (WIDTH, height + height % 2), GROUND)
    draw = ImageDraw.Draw(picture)
    circles, corners = ground_plan(scene, recorded.env.camera_height_m)
    for x_m, y_m, radius_m in circles:
        ((across, down),) = _on_plan(recorded, np.array([x_m, y_m]))
        draw.circle((across, down), max(1.5, radius_m * _scale(recorded)), OBSTACLE)
    for own in corners:
        draw.polygon(_on_plan(recorded, own), OBSTACLE)
    half_m, goal_m = 0.5 * scene.width_m, scene.length_m
    for side_m in (-half_m, half_m):
        draw.line(_on_plan(recorded, np.array([(side_m, 0.0), (side_m, goal_m)])), WALL, 3)
    draw.line(_on_plan(recorded, np.array([(-half_m, goal_m), (half_m, goal_m)])), GOAL, 3)
    draw.rectangle((0, 0, WIDTH, TOP - 1), INK)  # covers obstacles outside the plan
    _write(picture, (GAP, HEAD // 2), title, TEXT, FONT, "lm")
    _write(
        picture, (GAP, TOP - LINE // 2), "from above: start on the left, goal on the right", DIM, SMALL, "lm"
    )
    return picture


def _frame(
    canvas: Image.Image,
    recorded: RecordedEpisode,
    places: tuple[int, int],
    shown: tuple[Decode | None, float],
) -> Image.Image:
    """Draw one moment; the trajectory so far stays on the canvas.

    `places` are the indices of the previous moment and this one. `shown` has the decoder of the latent, or
    None, and the latent's value at a full bar.
    """
    (first, place), (decode, largest) = places, shown
    moment, moments = recorded.moments[place], recorded.moments
    way = _on_plan(recorded, np.array([(one.x_m, one.y_m) for one in moments[first : place + 1]]))
    ImageDraw.Draw(canvas).line(way, TRAIL, 3)
    picture = canvas.copy()
    draw = ImageDraw.Draw(picture)
    draw.circle(way[-1], 7, CHOSEN, TEXT, 2)
    if place == len(moments) - 1:
        _draw_end(picture, recorded)
    facts = f"step {place + 1} of {len(moments)}   {moment.t_us / 1e6:4.2f} s   {moment.y_m:5.1f} m"
    _write(picture, (WIDTH - GAP, HEAD // 2), facts, TEXT, FONT, "rm")
    left = GAP
    for name, panel in _panels(moment, decode):
        _write(picture, (left, HEAD + LINE // 2), name, DIM, SMALL, "lm")
        picture.paste(_enlarged(panel), (left, HEAD + LINE))
        left += SIDE + GAP
    right = WIDTH - GAP - left
    _draw_choice(picture, (left, HEAD, right, 150), moment)
    if moment.latent is not None:
        _draw_latent(picture, (left, HEAD + 160, right, SIDE + LINE - 160), moment.latent, largest)
    return picture


def _panels(moment: Moment, decode: Decode | None) -> list[tuple[str, np.ndarray]]:
    """Return name and picture, uint8 (H, W, 3), of each panel."""
    panels = [("camera", np.repeat(grey_picture(moment.luminance)[:, :, None], 3, axis=2))]
    if moment.events is not None:
        name = f"events of this step: {moment.num_events} (blue ON, orange OFF)"
        panels.append((name, coloured(signs(moment.events))))
    if decode is not None:
        panels.append(("decoded from the latent", coloured(decode(moment.observation))))
    return panels


def _enlarged(panel: np.ndarray) -> Image.Image:
    height, width = panel.shape[:2]
    scale = SIDE / max(height, width)
    size = round(width * scale), round(height * scale)
    return Image.fromarray(panel).resize(size, Image.Resampling.NEAREST)


def _draw_choice(picture: Image.Image, box: Box, moment: Moment) -> None:
    """Draw the probability of each action as a bar; the chosen action has another colour."""
    draw, (left, top, width, _) = ImageDraw.Draw(picture), box
    _write(picture, (left, top + LINE // 2), "probability of each action (taken: amber)", DIM, SMALL, "lm")
    if moment.probabilities.size > len(HEADINGS):
        _draw_choices(picture, box, moment)
        return
    start, length = left + 74, width - 74 - 56
    for row, (name, action) in enumerate(HEADINGS):
        share, y = moment.probabilities[action], top + LINE + 8 + row * 36
        _write(picture, (left, y + 12), name, TEXT, SMALL, "lm")
        draw.rectangle((start, y, start + length, y + 24), GROUND)
        colour = CHOSEN if action == moment.action else WALL
        draw.rectangle((start, y, start + share * length, y + 24), colour)
        _write(picture, (left + width, y + 12), f"{share:.0%}", TEXT, SMALL, "rm")


def _draw_choices(picture: Image.Image, box: Box, moment: Moment) -> None:
    """Draw the probabilities of many actions as vertical bars, from the left to the right command."""
    draw, (left, top, width, height) = ImageDraw.Draw(picture), box
    bottom, pitch = top + height - LINE, width / moment.probabilities.size
    for action, share in enumerate(moment.probabilities.tolist()):
        x, high = left + (action + 0.15) * pitch, share * (bottom - top - LINE - 8)
        colour = CHOSEN if action == moment.action else WALL
        draw.rectangle((x, bottom - high, x + 0.7 * pitch, bottom), colour)
    _write(picture, (left, bottom + LINE // 2), "left", TEXT, SMALL, "lm")
    _write(picture, (left + width, bottom + LINE // 2), "right", TEXT, SMALL, "rm")


def _draw_latent(picture: Image.Image, box: Box, latent: np.ndarray, largest: float) -> None:
    """Draw each number of the latent as a bar up or down; `largest` is the value at a full bar."""
    draw, (left, top, width, height) = ImageDraw.Draw(picture), box
    text = f"latent: the {len(latent)} numbers that the policy sees of the events"
    _write(picture, (left, top + LINE // 2), text if width > 400 else "latent", DIM, SMALL, "lm")
    draw.rectangle((left, top + LINE, left + width, top + height), GROUND)
    middle, half = top + (LINE + height) / 2, (height - LINE) / 2 - 3
    pitch = width / len(latent)
    for place, value in enumerate(latent):
        x, end = left + (place + 0.15) * pitch, middle - half * float(value) / largest
        draw.rectangle((x, min(middle, end), x + 0.7 * pitch, max(middle, end)), TRAIL)
    draw.line((left, middle, left + width, middle), WALL)


def _draw_end(picture: Image.Image, recorded: RecordedEpisode) -> None:
    """Mark where and how the episode ends."""
    outcome, row = outcome_of(recorded.episode), recorded.episode
    ((x, y),) = _on_plan(recorded, np.array([row["x_m"], row["distance_m"]]))
    ImageDraw.Draw(picture).circle((x, y), 10, COLOURS[outcome], TEXT, 2)
    near_goal = x > 0.8 * WIDTH
    _write(picture, (x + (-18 if near_goal else 18), y), outcome, TEXT, FONT, "rm" if near_goal else "lm")
