"""What a policy keeps of one control step: an array of fixed size, made once from what it sees.

`FEATURES` says for each feature its type, its shape, and how it is made, from a batch of
observations or from the events of one step. Settings are those of a policy's manifest: "width"
and "height" of the sensor [pixels], "latent" and "time_bins" of the encoder. The encoder is an
`EncoderTable`, or None where the feature needs none.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numba
import numpy as np

from models.encoder.event_batch import Grid, event_rows, index_events, index_packed, thin
from models.encoder.finetuned import EVENTS as ENCODED_EVENTS
from models.kinds import kind_of
from models.policy.event_set import EVENTS, TIMES

ON, OFF = 255, 125  # picture values of polarities (appendix D.1.2)
GAMMA = 2.2
Settings = Mapping[str, Any]
Step = tuple[Any, int, int]


class Feature(NamedTuple):
    """How a feature is made.

    Attributes:
        dtype: Of its array.
        shape: Settings -> its shape.
        from_observations: (observations (B, ...), settings, encoder) -> features (B, ...) of that shape.
        from_events: (step, settings, encoder) -> feature, of a step (events, start_us, window_us);
            None: events do not say it.
    """

    dtype: type
    shape: Callable[[Settings], tuple[int, ...]]
    from_observations: Callable[[np.ndarray, Settings, Any], np.ndarray]
    from_events: Callable[[Step, Settings, Any], np.ndarray] | None


def feature_of(settings: Settings) -> Feature:
    """The feature of the policy that `settings` describe."""
    return FEATURES[kind_of(settings).feature]


def push_features(stacks: np.ndarray, features: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Append the newest feature to each stack; the first of a flight fills its whole stack.

    Args:
        stacks: (B, stack, ...), oldest feature first.
        features: (B, ...) of the same type.
        first: bool (B,), True where the feature is the first of a flight.

    Returns:
        (B, stack, ...), a new array.
    """
    pushed = np.empty_like(stacks)
    pushed[:, :-1] = stacks[:, 1:]
    pushed[:, -1] = features
    pushed[first] = features[first][:, None]
    return pushed


def column_counts(address: np.ndarray, width: int, height: int) -> np.ndarray:
    """log(1 + count) of the ON, then of the OFF events in each image column, float32 (2 * width,).

    Args:
        address: int32 (2, N) of `models.encoder.event_batch`: row 0 is ((p > 0) * height + y) * width + x.
        width: Pixels.
        height: Pixels.
    """
    off = address[0] < width * height
    counts = np.bincount(address[0] % width + width * off, minlength=2 * width)
    return np.log1p(counts).astype(np.float32)


def event_picture(address: np.ndarray, width: int, height: int) -> np.ndarray:
    """255 where a pixel's last event was ON, 125 where it was OFF, else 0: uint8 (H, W).

    The rule of `envs.events.event_image` (appendix D.1.2); events in time order, arguments
    as in `column_counts`.
    """
    picture = np.zeros(width * height, np.uint8)
    _draw(address[0], picture)
    return picture.reshape(height, width)


def grey_picture(luminance: np.ndarray) -> np.ndarray:
    """Linear luminance as a camera stores it: gamma 2.2, 8 bits; uint8 of the same shape, 1 is white.

    The paper's policy sees 8-bit RGB images (appendix D.1.2). This world is grey, so that
    three equal channels would say no more than one. Brighter than white becomes white.

    Raises:
        ValueError: The luminance is NaN or infinite.
    """
    if not np.isfinite(luminance).all():
        raise ValueError("luminance must be finite, got NaN or infinity")
    return np.rint(255.0 * np.clip(luminance, 0.0, 1.0) ** (1.0 / GAMMA)).astype(np.uint8)


@numba.njit(cache=True, error_model="numpy")
def _draw(code, picture) -> None:  # type: ignore[no-untyped-def]
    for n in range(len(code)):
        picture[code[n] % len(picture)] = ON if code[n] >= len(picture) else OFF


def _grid(settings: Settings, time_bins: int = 1) -> Grid:
    return Grid(settings["width"], settings["height"], time_bins)


def _address(step: Step, settings: Settings, time_bins: int = 1) -> np.ndarray:
    events, start_us, window_us = step
    fields = tuple(events[name] for name in "txyp")
    return index_events(fields, start_us, window_us, _grid(settings, time_bins))


def _picture_shape(settings: Settings) -> tuple[int, ...]:
    return settings["height"], settings["width"]


def _pictures(observations: np.ndarray, settings: Settings, dtype: type) -> np.ndarray:
    """The observations, if they are pictures of this sensor."""
    shape = _picture_shape(settings)
    if observations.dtype != dtype or observations.shape[1:] != shape:
        rule = f"must be {np.dtype(dtype)} (B, {shape[0]}, {shape[1]})"
        raise ValueError(f"observations {rule}, got {observations.dtype} {observations.shape}")
    return observations


def _latents_of_windows(windows: np.ndarray, settings: Settings, encoder: Any) -> np.ndarray:
    return encoder.encode_windows(windows)


def _latent_of_step(step: Step, settings: Settings, encoder: Any) -> np.ndarray:
    return encoder.encode(*step)


def _columns_of_windows(windows: np.ndarray, settings: Settings, encoder: Any) -> np.ndarray:
    grid = _grid(settings)
    counts = np.empty((len(windows), 2 * grid.width), np.float32)
    for row, window in enumerate(windows):
        counts[row] = column_counts(index_packed(window, grid), grid.width, grid.height)
    return counts


def _columns_of_step(step: Step, settings: Settings, encoder: Any) -> np.ndarray:
    return column_counts(_address(step, settings), settings["width"], settings["height"])


def _rows(address: np.ndarray, grid: Grid, most: int) -> np.ndarray:
    return event_rows(thin(address, most), most, grid.width, grid.height)


def _rows_of_windows(windows: np.ndarray, grid: Grid, most: int) -> np.ndarray:
    rows = np.empty((len(windows), most, 4), np.int16)
    for row, window in zip(rows, windows, strict=True):
        row[:] = _rows(index_packed(window, grid), grid, most)
    return rows


def _set_of_windows(windows: np.ndarray, settings: Settings, encoder: Any) -> np.ndarray:
    return _rows_of_windows(windows, _grid(settings, TIMES), EVENTS)


def _set_of_step(step: Step, settings: Settings, encoder: Any) -> np.ndarray:
    return _rows(_address(step, settings, TIMES), _grid(settings, TIMES), EVENTS)


def _encoded_of_windows(windows: np.ndarray, settings: Settings, encoder: Any) -> np.ndarray:
    return _rows_of_windows(windows, _grid(settings, settings["time_bins"]), ENCODED_EVENTS)


def _encoded_of_step(step: Step, settings: Settings, encoder: Any) -> np.ndarray:
    time_bins = settings["time_bins"]
    return _rows(_address(step, settings, time_bins), _grid(settings, time_bins), ENCODED_EVENTS)


def _same_pictures(pictures: np.ndarray, settings: Settings, encoder: Any) -> np.ndarray:
    return _pictures(pictures, settings, np.uint8)


def _picture_of_step(step: Step, settings: Settings, encoder: Any) -> np.ndarray:
    return event_picture(_address(step, settings), settings["width"], settings["height"])


def _grey_of_luminance(luminance: np.ndarray, settings: Settings, encoder: Any) -> np.ndarray:
    return grey_picture(_pictures(luminance, settings, np.float32))


FEATURES = {
    "latent": Feature(
        np.float32, lambda settings: (settings["latent"],), _latents_of_windows, _latent_of_step
    ),
    "columns": Feature(
        np.float32, lambda settings: (2 * settings["width"],), _columns_of_windows, _columns_of_step
    ),
    "events": Feature(np.int16, lambda settings: (EVENTS, 4), _set_of_windows, _set_of_step),
    "event_rows": Feature(
        np.int16, lambda settings: (ENCODED_EVENTS, 4), _encoded_of_windows, _encoded_of_step
    ),
    "event_image": Feature(np.uint8, _picture_shape, _same_pictures, _picture_of_step),
    "grey": Feature(np.uint8, _picture_shape, _grey_of_luminance, None),
}
