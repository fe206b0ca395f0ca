"""Pixel values of pictures that the simulator draws and that policies read (appendix D.1.2)."""

import numpy as np

GAMMA = 2.2
GREY_ON, GREY_OFF = 255, 125  # a pixel of an event image whose last event was ON, OFF; 0 without an event


def grey_picture(luminance: np.ndarray) -> np.ndarray:
    """Convert linear luminance to a camera's 8-bit values (gamma 2.2): uint8 of the same shape.

    The paper's policy gets 8-bit RGB images (appendix D.1.2). This world is grey, so three equal channels
    would add nothing. Luminance above 1 (white) is clipped.

    Raises:
        ValueError: The luminance is NaN or infinite.
    """
    if not np.isfinite(luminance).all():
        raise ValueError("luminance must be finite, got NaN or infinity")
    return np.rint(255.0 * np.clip(luminance, 0.0, 1.0) ** (1.0 / GAMMA)).astype(np.uint8)
