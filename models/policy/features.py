"""The features of a policy: its input of one control step, as an array of fixed size.

Each `Feature` defines its type and shape, and how to compute it from a batch of event windows or pictures.
`models.kinds.KINDS` names the feature of each kind of policy.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from core.pictures import GREY_OFF, GREY_ON, grey_picture
from core.places import resolve
from models.encoder.event_batch import EventBatch, Grid, batch_packed, batch_windows, event_rows, thin
from models.encoder.event_images import draw_last
from models.encoder.finetuned import EVENTS as ENCODED_EVENTS
from models.encoder.frozen import Encoder
from models.kinds import PolicySpec
from models.policy.event_set import EVENTS, TIMES

Windows = np.ndarray | Sequence[np.ndarray]  # packed windows, of equal or different lengths


class Step(NamedTuple):
    """The events of one control step.

    Attributes:
        events: Integer arrays t, x, y, p by name, such as an EVENT array, in time order.
        start_us: Start of the step on the clock of the events [us].
        window_us: Length of the step [us].
    """

    events: Any
    start_us: int
    window_us: int


class Feature(NamedTuple):
    """The definition of a feature.

    Attributes:
        dtype: Type of its array.
        shape: policy -> shape of the array.
        from_observations: (B observations, policy, encoder) -> features (B, ...) of that shape.
        from_events: (step, policy, encoder) -> feature; None: it cannot be computed from events.

    `encoder` is the policy's frozen encoder, or None. `of_windows` derives both functions from one.
    """

    dtype: type
    shape: Callable[[PolicySpec], tuple[int, ...]]
    from_observations: Callable[[Any, PolicySpec, Any], np.ndarray]
    from_events: Callable[[Step, PolicySpec, Any], np.ndarray] | None


def of_windows(
    dtype: type,
    shape: Callable[[PolicySpec], tuple[int, ...]],
    compute: Callable[[EventBatch, PolicySpec, Any], np.ndarray],
    grid: Callable[[PolicySpec, Any], Grid] = lambda spec, encoder: Grid(spec.width, spec.height, 1),
) -> Feature:
    """Return a feature that one function computes from event windows, in training and from raw events.

    Args:
        dtype: See `Feature`.
        shape: See `Feature`.
        compute: (batch of B windows, policy, encoder) -> features (B, ...).
        grid: (policy, encoder) -> sensor size and time bins of the batch.
    """

    def from_observations(windows: Windows, spec: PolicySpec, encoder: Any) -> np.ndarray:
        return compute(batch_packed(windows, grid(spec, encoder)), spec, encoder)

    def from_events(step: Step, spec: PolicySpec, encoder: Any) -> np.ndarray:
        return compute(batch_windows([step], grid(spec, encoder)), spec, encoder)[0]

    return Feature(dtype, shape, from_observations, from_events)


def feature_of(spec: PolicySpec) -> Feature:
    """Return the feature of a policy."""
    feature: Feature = resolve(spec.kind.feature)
    return feature


def push_features(stacks: np.ndarray, features: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Append the newest feature to each stack; the first of an episode fills its whole stack.

    Args:
        stacks: (B, stack, ...), oldest feature first.
        features: (B, ...) of the same type.
        first: bool (B,), True where the feature is the first of an episode.

    Returns:
        (B, stack, ...), a new array.
    """
    pushed = np.empty_like(stacks)
    pushed[:, :-1] = stacks[:, 1:]
    pushed[:, -1] = features
    pushed[first] = features[first][:, None]
    return pushed


def column_counts(batch: EventBatch, bands: Sequence[int] = ()) -> np.ndarray:
    """Return log(1 + count) of the ON, then of the OFF events in each column of each band of the image.

    Args:
        batch: B windows.
        bands: See `models.kinds.ColumnsModel`; events in other rows are not counted.

    Returns:
        float32 (B, 2 * bands * width).
    """
    width, height, _ = batch.grid
    edges = bands or (0, height)
    count, below = len(edges) - 1, batch.code < width * height
    band = np.searchsorted(edges, np.arange(height), side="right") - 1  # of each row; -1 or `count`: none
    band = band[batch.code // width % height]
    place = ((2 * batch.window + below) * count + band) * width + batch.code % width
    place = place[(band >= 0) & (band < count)]
    counts = np.bincount(place, minlength=2 * count * width * len(batch))
    return np.log1p(counts).astype(np.float32).reshape(len(batch), 2 * count * width)


def event_picture(code: np.ndarray, width: int, height: int) -> np.ndarray:
    """Draw an event image: 255 where a pixel's last event was ON, 125 where OFF, else 0; uint8 (H, W).

    The rule is the same as in `envs.events.event_image` (appendix D.1.2). `code` holds the events in time
    order, as in `models.encoder.event_batch.EventBatch`.
    """
    picture = np.zeros(width * height, np.uint8)
    draw_last(code, picture, GREY_ON, GREY_OFF)
    return picture.reshape(height, width)


def _latents(batch: EventBatch, spec: PolicySpec, encoder: Encoder) -> np.ndarray:
    return encoder.encode_batch(batch)


def _columns(batch: EventBatch, spec: PolicySpec, encoder: None) -> np.ndarray:
    return column_counts(batch, spec.bands)


def _grid_of_encoder(spec: PolicySpec, encoder: Encoder) -> Grid:
    return encoder.grid


def _thinned_rows(most: int) -> Callable[[EventBatch, PolicySpec, Any], np.ndarray]:
    """Return a function that computes rows of at most `most` events of each window."""
    return lambda batch, spec, encoder: event_rows(thin(batch, most), most)


def _picture_shape(spec: PolicySpec) -> tuple[int, ...]:
    return spec.height, spec.width


def _pictures(observations: np.ndarray, spec: PolicySpec, dtype: type) -> np.ndarray:
    """Return the observations without a channel axis; raise ValueError unless they fit this sensor."""
    shape = _picture_shape(spec)
    if observations.dtype != dtype or observations.shape[1:] not in (shape, (*shape, 1)):
        rule = f"must be {np.dtype(dtype)} (B, {shape[0]}, {shape[1]}, 1), or without the 1"
        raise ValueError(f"observations {rule}, got {observations.dtype} {observations.shape}")
    return observations.reshape(-1, *shape)


def _same_pictures(pictures: np.ndarray, spec: PolicySpec, encoder: None) -> np.ndarray:
    return _pictures(pictures, spec, np.uint8)


def _picture_of_step(step: Step, spec: PolicySpec, encoder: None) -> np.ndarray:
    batch = batch_windows([step], Grid(spec.width, spec.height, 1))
    return event_picture(batch.code, spec.width, spec.height)


def _grey_of_luminance(luminance: np.ndarray, spec: PolicySpec, encoder: None) -> np.ndarray:
    return grey_picture(_pictures(luminance, spec, np.float32))


LATENT = of_windows(np.float32, lambda spec: (spec.evae.latent,), _latents, _grid_of_encoder)
COLUMNS = of_windows(np.float32, lambda spec: (2 * (len(spec.bands) - 1) * spec.width,), _columns)
EVENT_SET = of_windows(
    np.int16,
    lambda spec: (EVENTS, 4),
    _thinned_rows(EVENTS),
    lambda spec, encoder: Grid(spec.width, spec.height, TIMES),
)
EVENT_ROWS = of_windows(
    np.int16,
    lambda spec: (ENCODED_EVENTS, 4),
    _thinned_rows(ENCODED_EVENTS),
    lambda spec, encoder: Grid(spec.width, spec.height, spec.evae.time_bins),
)
EVENT_IMAGE = Feature(np.uint8, _picture_shape, _same_pictures, _picture_of_step)
GREY = Feature(np.uint8, _picture_shape, _grey_of_luminance, None)
