"""The observation of a control step, and a picture of it for people."""

import numpy as np
from gymnasium import spaces

from core.pictures import GREY_OFF, GREY_ON, grey_picture
from envs.config import EnvConfig
from envs.events import EVENT, event_image

ZOOM = 4
ON_RGB, OFF_RGB = (96, 165, 250), (249, 115, 22)  # events in every picture for people


def observation_space(config: EnvConfig) -> spaces.Space:
    """Return the space of the observation that `config.observation` names.

    Returns:
        "window": int32 (capacity + 1, 4), see `envs.events.pack_window`, or (N + 1, 4) for N events if the
        capacity is None; "event_image": uint8 (H, W, 1); "luminance": float32 (H, W, 1); "events": rows
        [t [us], x, y, p], int64; "none": uint8 (0,). Pictures have a channel axis because the networks of
        other libraries, such as stable-baselines3's CnnPolicy, require one.
    """
    shape = (config.camera.height, config.camera.width, 1)
    if config.observation == "window":
        capacity, most = config.window_capacity, np.iinfo(np.int32).max
        if capacity is None:
            return spaces.Sequence(spaces.Box(-1, most, (4,), np.int32), stack=True)
        return spaces.Box(-1, most, (capacity + 1, 4), np.int32)
    if config.observation == "event_image":
        return spaces.Box(0, 255, shape, np.uint8)
    if config.observation == "luminance":
        return spaces.Box(0.0, np.inf, shape, np.float32)
    if config.observation == "none":
        return spaces.Box(0, 255, (0,), np.uint8)
    return spaces.Sequence(spaces.Box(-1, 2**53, (4,), np.int64), stack=True)


def observe(config: EnvConfig, events: np.ndarray, luminance: np.ndarray) -> np.ndarray:
    """Return the observation of one control step as a fresh array; `envs.events.windows` packs windows.

    Args:
        config: Settings that name the observation.
        events: EVENT of the step, valid and in time order.
        luminance: float32 (H, W), the last render.
    """
    if config.observation == "event_image":
        return event_image(events, config.camera.width, config.camera.height)[:, :, None]
    if config.observation == "luminance":
        return luminance[:, :, None].copy()
    if config.observation == "none":
        return np.empty(0, np.uint8)
    return np.stack([events[name].astype(np.int64) for name in EVENT.fields or ()], axis=1)


def picture(events: np.ndarray, luminance: np.ndarray) -> np.ndarray:
    """Draw luminance (gamma 2.2) and events side by side, enlarged four times; ON is blue, OFF orange.

    Args:
        events: EVENT in time order.
        luminance: float32 (H, W); 1 is white.

    Returns:
        uint8 (4 H, 8 W, 3).
    """
    height, width = luminance.shape
    grey = grey_picture(luminance)
    polarity = event_image(events, width, height)
    image = np.repeat(np.concatenate((grey, np.zeros_like(polarity)), axis=1)[:, :, None], 3, axis=2)
    image[:, width:][polarity == GREY_ON] = ON_RGB
    image[:, width:][polarity == GREY_OFF] = OFF_RGB
    return image.repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)
