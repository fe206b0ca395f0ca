"""Films of flights: what the camera sees, its events, and what the latents hold of them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jobs.analysis.plots import EVENT_COLOURS, INK

ZOOM, GAP, BAR = 5, 12, 40
FILM_FPS, FRAMES_PER_FLOWN_S = 25, 50

Decode = Callable[[np.ndarray], np.ndarray]


class Film:
    """An MP4 file of one flight: luminance, events if any are made, with a decoder what the latents hold.

    A context manager; `step` takes what one control step has shown. Frames are
    `FRAMES_PER_FLOWN_S` per second of flight, played `FILM_FPS` per second.
    """

    def __init__(self, path: Path, control_hz: float, decode: Decode | None) -> None:
        """Open the file.

        Args:
            path: Where it is written, whole or not at all.
            control_hz: Control steps per second of flight [Hz].
            decode: Event window -> picture in [-1, 1], float (H, W), of a third panel; None: there is none.
        """
        self.path, self.decode = path, decode
        self.stride = max(1, round(control_hz / FRAMES_PER_FLOWN_S))
        self.slower = control_hz / self.stride / FILM_FPS
        self._recent: list[np.ndarray | None] = []
        self._part = path.with_name(f".{path.stem}.part.mp4")

    def __enter__(self) -> "Film":
        """Start the encoder."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._writer: Any = imageio.get_writer(
            self._part, fps=FILM_FPS, codec="libx264", quality=7, macro_block_size=2, ffmpeg_log_level="error"
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file; it takes its name only if nothing went wrong."""
        self._writer.close()
        if kind is None:
            self._part.replace(self.path)
        else:
            self._part.unlink(missing_ok=True)

    def step(
        self, luminance: np.ndarray, events: np.ndarray | None, window: np.ndarray, caption: str
    ) -> None:
        """Show a control step: its luminance (H, W), its EVENT array or None if none are made, its window."""
        self._recent.append(events)
        if len(self._recent) < self.stride:
            return
        shown = [batch for batch in self._recent if batch is not None]
        self._recent = []
        panels = [("luminance", grey(luminance))]
        if shown:
            panels.append(("events", coloured(polarity(np.concatenate(shown), luminance.shape))))
        if self.decode is not None:
            panels.append(("decoded from the latents", coloured(self.decode(window))))
        note = f"{caption}   {self.slower:.0f}x slower than flown" if self.slower > 1 else caption
        self._writer.append_data(frame(panels, note))


def grey(luminance: np.ndarray) -> np.ndarray:
    """Linear luminance (H, W) as uint8 (H, W, 3), with the display's gamma."""
    shade = np.rint(255 * np.clip(luminance, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    return np.repeat(shade[:, :, None], 3, axis=2)


def polarity(events: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The last polarity of each pixel, -1, 0 or +1, float64 (H, W); events in time order."""
    picture = np.zeros(shape)
    picture[events["y"], events["x"]] = events["p"]
    return picture


def coloured(picture: np.ndarray) -> np.ndarray:
    """A picture in [-1, 1] as uint8 (H, W, 3): OFF orange, ON blue."""
    return EVENT_COLOURS((np.clip(picture, -1, 1) + 1) / 2, bytes=True)[:, :, :3]


def frame(panels: Sequence[tuple[str, np.ndarray]], caption: str) -> np.ndarray:
    """Panels uint8 (H, W, 3) side by side under their names, above a caption; uint8 with even sizes."""
    height, width = panels[0][1].shape[:2]
    # The caption needs the room of two.
    size = (max(2, len(panels)) * (width * ZOOM + GAP) + GAP, height * ZOOM + 2 * BAR)
    picture = Image.new("RGB", size, INK)
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(17)
    for place, (name, panel) in enumerate(panels):
        x = GAP + place * (width * ZOOM + GAP)
        enlarged = panel.repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)
        picture.paste(Image.fromarray(enlarged), (x, BAR))
        draw.text((x, BAR // 2), name, "white", font, anchor="lm")
    draw.text((GAP, size[1] - BAR // 2), caption, "#cbd5e1", font, anchor="lm")
    return np.asarray(picture)
