"""Films of episodes: luminance, events, and the pictures decoded from the latents."""

import contextlib
import re
import subprocess
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from core.files import replaced
from core.pictures import GREY_OFF, GREY_ON, grey_picture
from envs.events import event_image
from jobs.analysis.colours import EVENTS, INK
from jobs.run.files import RunError
from models.encoder.evae import pictures, reconstruct
from models.encoder.event_batch import batch_packed
from models.encoder.weights import load_encoder
from models.policy.policy import ENCODER

ZOOM, GAP, BAR = 5, 12, 40
FILM_FPS, FRAMES_PER_FLIGHT_S = 25, 50
QUALITY = 7  # 0 to 10, best
FRAMES = ("-map", "0:v:0", "-c", "copy", "-f", "null", "-")  # make ffmpeg count the frames

Decode = Callable[[np.ndarray], np.ndarray]


@dataclass
class Film:
    """The MP4 file of an episode while it is written; see `open_film`."""

    part: Path
    control_hz: float
    decode: Decode | None
    fps: float = FILM_FPS
    _writer: Generator[None, np.ndarray | None, None] | None = None
    _recent: list[tuple[np.ndarray, np.ndarray | None, np.ndarray, str]] = field(default_factory=list)
    _frames: int = 0

    def step(
        self, luminance: np.ndarray, events: np.ndarray | None, window: np.ndarray, caption: str
    ) -> None:
        """Add a control step: luminance (H, W), EVENT array (None if none are simulated), and window."""
        self._recent.append((np.array(luminance), events, window, caption))
        if len(self._recent) == self._stride:
            self.finish()

    @property
    def _stride(self) -> int:
        """Return the number of control steps of a picture."""
        return max(1, round(self.control_hz / FRAMES_PER_FLIGHT_S))

    def finish(self) -> None:
        """Show the steps since the last picture, so that a film ends with the last step of its episode."""
        if not self._recent:
            return
        luminance, _, window, caption = self._recent[-1]
        shown = [events for _, events, _, _ in self._recent if events is not None]
        self._recent = []
        panels = [("luminance", np.repeat(grey_picture(luminance)[:, :, None], 3, axis=2))]
        if shown:
            panels.append(("events", coloured(last_polarity(np.concatenate(shown), luminance.shape))))
        if self.decode is not None:
            panels.append(("decoded from the latents", coloured(self.decode(window))))
        slower = self.control_hz / self._stride / FILM_FPS
        self.add(frame(panels, f"{caption}   {slower:.0f}x slower" if slower > 1 else caption))

    def add(self, picture: np.ndarray) -> None:
        """Add a picture, uint8 (H, W, 3); all pictures have the same even size."""
        if self._writer is None:
            self._writer = _start_writer(self.part, picture, self.fps)
        self._frames += 1
        try:
            self._writer.send(picture)
        except OSError:  # ffmpeg has ended
            raise self._failure("fewer") from None

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()

    def check(self) -> None:
        """Check that the closed file has every frame, because ffmpeg's errors are not passed on.

        Raises:
            RunError: Frames are missing.
        """
        held = frames_of(self.part) if self._frames else 0
        if held != self._frames:
            raise self._failure(str(held))

    def _failure(self, held: str) -> RunError:
        """Return the error of a film that ffmpeg could not write."""
        rule = f"a film there must hold {self._frames} frames, got {held}: ffmpeg could not write them"
        return RunError(f"{self.part.parent}: {rule}; make room there, and give the same command again")


@contextlib.contextmanager
def open_film(path: Path, control_hz: float, decode: Decode | None, fps: float = FILM_FPS) -> Iterator[Film]:
    """Write an MP4 file of one episode: luminance, any events, and any pictures decoded from the latents.

    `Film.step` adds `FRAMES_PER_FLIGHT_S` frames per second of flight. The file is written whole or not
    at all.

    Args:
        path: The file.
        control_hz: Control steps per second of flight [Hz].
        decode: Event window -> picture in [-1, 1], float (H, W), for a third panel; None: no such panel.
        fps: Frames played per second [Hz].
    """
    with replaced(path) as part:
        with contextlib.closing(Film(part, control_hz, decode, fps)) as film:
            yield film
            film.finish()
        film.check()


def _start_writer(part: Path, picture: np.ndarray, fps: float) -> Generator[None, np.ndarray | None, None]:
    """Start imageio-ffmpeg's own ffmpeg for frames of the size of `picture`."""
    size = (picture.shape[1], picture.shape[0])
    look = {"codec": "libx264", "quality": QUALITY, "macro_block_size": 2}
    # An unfinished file's name does not show its format; x264's default preset takes a third longer.
    more = ["-f", "mp4", "-preset", "veryfast"]
    writer = imageio_ffmpeg.write_frames(
        str(part), size, fps=fps, ffmpeg_log_level="error", output_params=more, **look
    )
    writer.send(None)
    return writer


def frames_of(film: Path) -> int:
    """Return the number of frames of a film without decoding them; 0 if the film cannot be read."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(film), *FRAMES]
    done = subprocess.run(command, capture_output=True, check=False)  # noqa: S603  ffmpeg of a package
    counts = re.findall(rb"frame=\s*(\d+)", done.stderr)
    return int(counts[-1]) if counts and done.returncode == 0 else 0


def latent_decoder(policy: Path) -> Decode | None:
    """Return a function from an event window to the picture that is decoded from a policy's latents.

    None for a lean policy, which has no decoder.
    """
    evae, _ = load_encoder(policy / ENCODER)
    if evae.decoder is None:
        return None

    @torch.no_grad()
    def decode(window: np.ndarray) -> np.ndarray:
        logits = evae(batch_packed(window[None], evae.grid))[0]
        return pictures(reconstruct(logits, evae.target), evae.target, evae.grid)[0].numpy()

    return decode


def last_polarity(events: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the last polarity of each pixel, -1, 0 or +1, (H, W); events in time order."""
    return signs(event_image(events, shape[1], shape[0]))


def signs(image: np.ndarray) -> np.ndarray:
    """Return an event image as polarities -1, 0 or +1, of the same shape."""
    return np.select([image == GREY_ON, image == GREY_OFF], [1, -1])


def coloured(picture: np.ndarray) -> np.ndarray:
    """Return a picture in [-1, 1] as uint8 (H, W, 3): OFF orange, ON blue."""
    mixed = [np.interp(picture, (-1, 0, 1), channel) for channel in EVENTS.T]
    return np.stack(mixed, axis=-1).round().astype(np.uint8)


def frame(panels: Sequence[tuple[str, np.ndarray]], caption: str) -> np.ndarray:
    """Draw panels, uint8 (H, W, 3), side by side with their names above a caption; uint8, even sizes."""
    height, width = panels[0][1].shape[:2]
    across = max(2, len(panels))  # the caption needs the width of two
    sizes = (across * (width * ZOOM + GAP) + GAP, height * ZOOM + 2 * BAR)
    size = (sizes[0] + sizes[0] % 2, sizes[1] + sizes[1] % 2)  # the video encoder needs even sizes
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
