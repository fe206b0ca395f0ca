"""A registered policy as MLflow runs it: the observations of one episode in, an action per control step out.

MLflow stores this script and the packages `core` and `models` with the policy's files and runs them where the
model is loaded ("model from code"); nothing is pickled. A prediction is one episode from its start,
so that the same input gives the same answer.
"""

from collections.abc import Iterator
from typing import Any

import mlflow
import numpy as np
import pandas as pd
from mlflow.pyfunc import PythonModel

from models.policy import Policy, load_policy


class ServedPolicy(PythonModel):
    """A policy folder behind MLflow's interface."""

    def load_context(self, context: Any) -> None:
        """Read the policy that was registered."""
        self.loaded = load_policy(context.artifacts["policy"])

    # Annotated as a DataFrame only: with any other annotation MLflow warns or changes the input.
    def predict(
        self, context: Any, model_input: pd.DataFrame, params: dict[str, int] | None = None
    ) -> pd.DataFrame:
        """Return the likeliest action of each control step of one episode, with the logits of all actions.

        Args:
            context: MLflow's context; unused.
            model_input: Events as columns t [us since the episode's start], x, y [pixels], p (-1 or
                +1), in time order; for a policy that sees luminance float32 (steps, H, W).
            params: `window_us`, the length of a control step [us].

        Returns:
            A row per decision: `step` (0 at the episode's start, then one after each control step),
            `action` and a logit for each of `Policy.action_names`.

        Raises:
            ValueError: Events are before the episode's start, or not in time order.
        """
        policy = Policy(self.loaded.networks, self.loaded.spec, self.loaded.encoder)
        names = self.loaded.action_names
        if policy.observation == "luminance":
            logits = [policy.logits(picture[None])[0] for picture in np.asarray(model_input)]
        else:
            window_us = int((params or {})["window_us"])
            logits = [policy.event_logits(*step) for step in control_steps(model_input, window_us)]
        table = np.reshape(logits, (-1, len(names)))
        columns: dict[str, np.ndarray] = {"step": np.arange(len(table)), "action": table.argmax(axis=1)}
        return pd.DataFrame(columns | dict(zip(names, table.T, strict=True)))


def control_steps(events: pd.DataFrame, window_us: int) -> Iterator[tuple[dict[str, np.ndarray], int, int]]:
    """Yield the inputs of an episode's decisions: no events at its start, then those of each control step.

    Yields:
        Event fields by name, start and length [us] of each step, up to the step of the newest event. A step
        has the events with start < t <= start + window_us.

    Raises:
        ValueError: As `ServedPolicy.predict`.
    """
    fields = {name: events[name].to_numpy() for name in "txyp"}
    t = fields["t"]
    if len(t) and (t[0] <= 0 or np.any(np.diff(t) < 0)):
        raise ValueError(
            f"t must begin above 0, at the episode's start, and never fall, got {t[:3]}...; sort by t"
        )
    ends_us = np.arange(0, t[-1] + window_us if len(t) else 1, window_us)
    first = 0
    for end_us, stop in zip(
        ends_us.tolist(), np.searchsorted(t, ends_us, side="right").tolist(), strict=True
    ):
        yield {name: values[first:stop] for name, values in fields.items()}, end_us - window_us, window_us
        first = stop


mlflow.models.set_model(ServedPolicy())
