"""What a policy keeps of the past: its last features, or means of them that decay with time.

Kept features are an array (B, depth, ...), the newest last. A stack holds the last ones, whatever time lies
between them. Decaying means, one for each time constant, say how long something has been so, whatever the
rate of control: a feature holds until the next one, so that m <- f + (m - f) exp(-dt / tau).

A policy with `own_actions` appends to each feature which action it took last, as a one among zeros. The
decaying means then say what a vehicle with inertia or a delay is about to do, without a sensor for it.
One with `own_velocity` appends the velocity that the vehicle measures.
"""

import numpy as np

from models.kinds import PolicySpec
from models.policy.features import Feature, Windows, feature_of, push_features

VELOCITY_UNIT_MPS = 10.0  # what a network reads as 1, so that velocities are about as large as other features


def kept_shape(spec: PolicySpec, feature: Feature | None = None) -> tuple[int, ...]:
    """Return what is kept of an episode, which the networks read: (depth, *feature).

    Args:
        spec: The policy.
        feature: What is kept of a step; None: what its row says, as in training.

    Raises:
        ValueError: `own_actions` or `own_velocity` of a policy whose feature is not a vector of floats.
    """
    feature = feature or feature_of(spec)
    shape = feature.shape(spec)
    if not spec.own_size:
        return spec.depth, *shape
    if len(shape) != 1 or not np.issubdtype(feature.dtype, np.floating):
        name = "own_actions" if spec.own_actions else "own_velocity"
        rule = f"must be false for {spec.model.name}, whose feature is no vector of floats"
        raise ValueError(f"{name} {rule}, got True")
    return spec.depth, shape[0] + spec.own_size


def remember(
    kept: np.ndarray,
    features: np.ndarray,
    first: np.ndarray,
    spec: PolicySpec,
    window_us: np.ndarray | int,
    taken: np.ndarray,
    velocity_mps: np.ndarray | None = None,
) -> np.ndarray:
    """Add the newest feature of each episode to what was kept; the first of an episode fills all of it.

    Args:
        kept: (B, depth, ...) of `kept_shape`.
        features: (B, ...) of the same type.
        first: bool (B,), True where the feature is the first of an episode.
        spec: The policy.
        window_us: How long each feature took, (B,) or one for all [us]; a stack does not ask.
        taken: The action of each episode's last step, int (B,); only a policy with `own_actions` asks.
        velocity_mps: What each vehicle measures now, to the right and ahead, (B, 2) [m/s]; only a policy with
            `own_velocity` asks.

    Returns:
        (B, depth, ...), a new array.

    Raises:
        ValueError: A velocity is asked for, and is missing or not finite.
    """
    if spec.own_actions:
        known = np.zeros((len(features), spec.num_actions), features.dtype)
        known[np.arange(len(features)), taken] = ~first  # an episode begins without an action
        features = np.concatenate([features, known], axis=1)
    if spec.own_velocity:
        if velocity_mps is None or not np.isfinite(velocity_mps).all():
            rule = "this policy reads the vehicle's velocity: set policy.velocity_mps (B, 2) before each step"
            raise ValueError(f"{rule}, got {velocity_mps}")
        own = np.asarray(velocity_mps, features.dtype) / features.dtype.type(VELOCITY_UNIT_MPS)
        features = np.concatenate([features, own], axis=1)
    if not spec.memory_ms:
        return push_features(kept, features, first)
    tau_us = np.float32(1e3) * np.array(spec.memory_ms, np.float32)
    rest = np.exp(-np.asarray(window_us, np.float32).reshape(-1, 1) / tau_us)
    rest = rest.reshape(*rest.shape, *(1 for _ in features.shape[1:]))
    newest = features[:, None]
    means = newest + (kept[:, :-1] - newest) * rest
    return np.where(
        first.reshape(-1, *(1 for _ in features.shape)), newest, np.concatenate([means, newest], 1)
    )


def windows_us(observations: Windows, spec: PolicySpec) -> np.ndarray | int:
    """Return how long the packed window of each observation is [us]; 0 for a policy that does not ask."""
    return np.array([window[0, 2] for window in observations]) if spec.memory_ms else 0
