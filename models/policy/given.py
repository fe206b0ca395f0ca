"""Read the events and observations that callers pass to a policy, as arrays, lists or tensors.

Events must have fields named t, x, y, p or be rows of these four, in time order and within their control
step. Anything else raises an error that states `RULE`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

NAMES = ("t", "x", "y", "p")
RULE = (
    "events must be integers t [us], x, y [pixels] and p (-1 or +1, or booleans), by name or as rows (N, 4)"
)


def read_fields(events: Any) -> dict[str, np.ndarray]:
    """Return t, x, y, p by name, integers (N,) each.

    Args:
        events: A structured array, a mapping or a table with these names, or rows of these four: arrays,
            lists or tensors. If p is boolean, true is ON.

    Raises:
        ValueError: The events have none of these forms.
    """
    is_named = isinstance(events, Mapping) or hasattr(events, "columns")  # a pandas table
    given: Any = events if is_named else _array(events)
    if is_named or given.dtype.names:
        present = list(given if is_named else given.dtype.names)
        missing = [name for name in NAMES if name not in present]
        if missing:
            raise ValueError(f"{RULE}; got {present} without {', '.join(missing)}")
        columns = [_array(given[name]) for name in NAMES]
    else:
        columns = _columns(given)
    shapes = [column.shape for column in columns]
    if len(set(shapes)) > 1 or len(shapes[0]) != 1:
        raise ValueError(f"{RULE}; got t, x, y, p of shapes {', '.join(map(str, shapes))}")
    if not shapes[0][0]:
        return {name: np.empty(0, np.int64) for name in NAMES}
    if columns[3].dtype == bool:
        columns[3] = np.where(columns[3], np.int64(1), np.int64(-1))
    for name, column in zip(NAMES, columns, strict=True):
        if column.dtype.kind not in "iu":
            raise ValueError(f"{RULE}; event field {name} must hold integers, got {column.dtype}")
    return dict(zip(NAMES, columns, strict=True))


def check_step(fields: Mapping[str, np.ndarray], start_us: int, window_us: int) -> None:
    """Raise an error unless the events can belong to this control step.

    Raises:
        ValueError: Events are not in time order, lie outside [start_us, start_us + window_us], or have
            a p other than -1 and +1.
    """
    t, p = fields["t"], fields["p"]
    if not len(t):
        return
    back = t[1:] < t[:-1]
    if back.any():
        at = int(back.argmax()) + 1
        raise ValueError(
            f"events must be in time order; event {at} has t={t[at]} after {t[at - 1]}: sort them"
        )
    if not start_us <= int(t[0]) <= int(t[-1]) <= start_us + window_us:
        rule = f"must lie within their control step, t in [{start_us}, {start_us + window_us}] us"
        raise ValueError(f"events {rule}; got {t[0]} to {t[-1]}: give start_us on the clock of t")
    wrong = (p != 1) & (p != -1)
    if wrong.any():
        at = int(wrong.argmax())
        raise ValueError(f"{RULE}; event {at} has p={p[at]}: recode 0 as -1")


def read_observations(observations: Any, dtype: type) -> Any:
    """Return observations as one array, or as a list of one array per episode if the lengths differ.

    Args:
        observations: One observation per episode. Arrays and tensors keep their type.
        dtype: Type for lists of numbers, if it can represent them.
    """
    if isinstance(observations, np.ndarray | torch.Tensor):
        return _array(observations)
    each = [_typed(one, dtype) for one in observations]
    is_same = len(each) > 0 and len({(one.shape, one.dtype) for one in each}) == 1
    return np.stack(each) if is_same else each


def _typed(values: Any, dtype: type) -> np.ndarray:
    """Return an array, of `dtype` if the values are a list of numbers that it can represent."""
    array = _array(values)
    if isinstance(values, np.ndarray | torch.Tensor) or array.dtype.kind not in "iuf":
        return array
    cast: np.ndarray = array.astype(dtype)
    return cast if np.issubdtype(dtype, np.floating) or np.array_equal(cast, array) else array


def _array(values: Any) -> np.ndarray:
    """Return an array; a ragged list becomes an array without dimensions, which later checks reject."""
    if isinstance(values, torch.Tensor):
        return values.detach().cpu().numpy()
    try:
        return np.asarray(values)
    except ValueError:  # rows of different lengths
        return np.empty((), object)


def _columns(rows: np.ndarray) -> list[np.ndarray]:
    """Return the four columns of event rows (N, 4)."""
    if rows.shape == (0,):
        return [np.empty(0, np.int64)] * 4
    if rows.ndim != 2 or rows.shape[1] != len(NAMES):
        raise ValueError(f"{RULE}; got {rows.dtype} of shape {rows.shape}")
    return list(rows.T)
