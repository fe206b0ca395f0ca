"""Try out a policy's feature and network on a few observations before training."""

from typing import Any

import numpy as np
import torch

from models.kinds import PolicySpec, TrialError
from models.policy.features import feature_of
from models.policy.memory import kept_shape
from models.policy.networks import PARTS, build_networks, network_of

EPISODES, EVENTS, WINDOW_US = 3, 200, 5_000


def try_policy(spec: PolicySpec) -> None:
    """Compute feature, logits and values of a few random observations, for a policy without an encoder.

    Raises:
        TrialError: A result is not finite, or its shape or type differs from the row in `KINDS`.
        Exception: Whatever the feature or the network raises.
    """
    feature, seen = feature_of(spec), _observations(spec)
    made = feature.from_observations(seen, spec, None)
    _check("feature", made, np.dtype(feature.dtype), (EPISODES, *feature.shape(spec)))
    network = network_of(spec)
    networks = build_networks(spec)
    if len(networks) != len(PARTS):
        raise TrialError(f"its network must be {len(PARTS)} parts {PARTS}, got {len(networks)}")
    stacks = np.resize(made, (EPISODES, *kept_shape(spec)))
    state = np.zeros((EPISODES, network.state(spec)), np.float32)
    logits, after = network.run(networks["trunk"], networks["pi"])(stacks, state)
    _check("logits", logits, np.dtype(np.float32), (EPISODES, spec.num_actions))
    _check("next state", after, np.dtype(np.float32), state.shape)
    with torch.no_grad():
        read = torch.from_numpy(stacks)
        inputs = (read[:, None], torch.from_numpy(state)) if state.size else (read,)
        embeddings = networks["trunk"](*inputs)
        value = networks["vf"](embeddings[1] if state.size else embeddings).numpy()
    _check("value", value, np.dtype(np.float32), (EPISODES, 1))


def _check(what: str, found: Any, dtype: np.dtype, shape: tuple[int, ...]) -> None:
    if not isinstance(found, np.ndarray) or found.dtype != dtype or found.shape != shape:
        got = f"{found.dtype} {found.shape}" if isinstance(found, np.ndarray) else type(found).__name__
        raise TrialError(f"its {what} must be {dtype} {shape}, got {got}")
    if not np.isfinite(found).all():
        raise TrialError(f"its {what} must be finite, got NaN or infinity")


def _observations(spec: PolicySpec) -> Any:
    """Return an empty, a nearly empty and a full observation of the kind's environment."""
    rng, shape = np.random.default_rng(0), (EPISODES, spec.height, spec.width)
    if spec.kind.observation == "luminance":
        return rng.uniform(0.0, 1.0, shape).astype(np.float32)
    if spec.kind.observation == "event_image":
        return rng.choice(np.array([0, 125, 255], np.uint8), shape)
    windows = np.zeros((EPISODES, EVENTS + 1, 4), np.int32)
    for window, count in zip(windows, (0, 1, EVENTS), strict=True):
        window[0] = count, 0, WINDOW_US, 0
        window[1 : count + 1, 0] = np.sort(rng.integers(1, WINDOW_US + 1, count))
        window[1 : count + 1, 1] = rng.integers(0, spec.width, count)
        window[1 : count + 1, 2] = rng.integers(0, spec.height, count)
        window[1 : count + 1, 3] = rng.choice([-1, 1], count)
    return windows
