"""The memory of a policy: its last features, or means of them that decay with time.

Stored features are an array (B, depth, ...), the newest last. A stack holds the last features, regardless of
the time between them. Decaying means, one for each time constant, encode duration independently of the
control rate: a feature is constant until the next one, so that m <- f + (m - f) exp(-dt / tau).

A policy with `own_actions` appends its last action to each feature (one-hot). The decaying means then show
what a vehicle with inertia or a delay is about to do, without a sensor for it. A policy with `own_velocity`
appends the velocity that the vehicle measures.
"""

import numpy as np

from models.kinds import PolicySpec
from models.policy.features import Feature, Windows, feature_of, push_features

VELOCITY_UNIT_MPS = 10.0  # a network reads it as 1, so that velocities are about as large as other features


def kept_shape(spec: PolicySpec, feature: Feature | None = None) -> tuple[int, ...]:
    """Return the shape of an episode's stored features, which the networks read: (depth, *feature).

    Args:
        spec: The policy.
        feature: The feature of a step; None: the one in the policy's row of `KINDS`, as in training.

    Raises:
        ValueError: The policy has `own_actions` or `own_velocity`, but its feature is not a vector of floats.
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
    """Add each episode's newest feature to its stored features; an episode's first feature fills them all.

    Args:
        kept: Stored features (B, depth, ...), see `kept_shape`.
        features: (B, ...) of the same type.
        first: bool (B,), True where the feature is the first of an episode.
        spec: The policy.
        window_us: Duration of each feature's step, (B,) or one for all [us]; not used by a stack.
        taken: The action of each episode's last step, int (B,); used only with `own_actions`.
        velocity_mps: Velocity that each vehicle measures now, to the right and ahead, (B, 2) [m/s]; used only
            with `own_velocity`.

    Returns:
        (B, depth, ...), a new array.

    Raises:
        ValueError: The policy has `own_velocity`, and the velocity is missing or not finite.
    """
    if spec.own_actions:
        known = np.zeros((len(features), spec.num_actions), features.dtype)
        known[np.arange(len(features)), taken] = ~first  # no action precedes an episode
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
    """Return the length of each observation's packed window [us]; 0 for a policy that does not use it."""
    return np.array([window[0, 2] for window in observations]) if spec.memory_ms else 0
