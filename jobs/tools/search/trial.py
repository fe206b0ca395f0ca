"""One trial of a search: a training in one process, measured regularly in validation corridors."""

import dataclasses
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from jobs.config.config import Config
from jobs.rollout.agents import make_agent
from jobs.rollout.episodes import roll_out
from jobs.run.checkpoints import drop_unfinished, unfinished
from jobs.run.files import read_json, write_atomic, write_json
from jobs.run.folder import Run
from jobs.run.torch_threads import torch_threads
from jobs.tools.search.space import encoder_facts, read_settings, with_settings
from jobs.tracking.tracker import Tracker
from jobs.training.algorithms import algorithm_of
from jobs.training.pretrain import prepare_encoder
from jobs.training.train import ENV_STEPS, TrainingError, export_policy, read_metrics
from jobs.training.trainable import Trainable
from models.policy.policy import ENCODER, NETWORKS

PROGRESS = "trial.json"  # in a checkpoint
NOT_FINITE = "finite"  # part of the error message of a diverged training
SIDE_BY_SIDE = 8  # parallel episodes of a measurement

Files = Mapping[str, bytes]  # name -> content, for machines without access to the driver's folders


class Unrecorded:
    """A tracker that records nothing, because only the driver writes to the tracking store."""

    def __getattr__(self, name: str) -> Any:
        """Return a function that does nothing."""
        return lambda *args, **kwargs: None


class SearchTrial(Trainable):
    """A training with the drawn settings; each of its steps ends with a measurement."""

    @torch_threads(1)
    def setup(self, config: dict[str, Any], base: Config, files: Files) -> None:
        """Build the training.

        Args:
            config: The settings as Tune has drawn them.
            base: The experiment that these settings change.
            files: Files of the shared encoder and of the initial policy, if there are any.
        """
        drop_unfinished(self.checkpoints())
        self._steps, self._experiment = 0, with_settings(base, read_settings(config))
        place = Path(self.logdir)
        for name, content in files.items():
            write_atomic(place / "inputs" / name, content)
        shared = encoder_facts(self._experiment) == encoder_facts(base)
        self._encoder = place / "inputs" / ENCODER if ENCODER in files and shared else None
        if not shared:
            own = Run(place / "run", self._experiment)
            self._encoder = prepare_encoder(own, cast(Tracker, Unrecorded()))
        init = place / "inputs" / NETWORKS if NETWORKS in files else None
        self._algorithm = algorithm_of(self._experiment)
        built = self._algorithm.build(self._experiment, self._encoder, init)
        self._training = self._algorithm.trainable(self._experiment)(config=built)

    @torch_threads(1)
    def step(self) -> dict[str, Any]:
        """Train up to the next measurement, and measure; a diverged training ends with 0 m."""
        asked = self._experiment
        until = min(self._steps + asked.own.report_steps, asked.train.env_steps)
        metrics: dict[str, float] = {}
        try:
            while self._steps < until:
                began_s = time.monotonic()
                result = self._training.train()
                self._steps = int(result[ENV_STEPS])
                passed_s = time.monotonic() - began_s
                metrics = read_metrics({**result, "trial_restarts": 0}, passed_s, self._algorithm)
            figures = self.measured()
        except (TrainingError, RuntimeError, ValueError) as error:
            if NOT_FINITE not in str(error):
                raise
            figures = {"distance_m": 0.0, "success_rate": 0.0, "diverged": 1.0}
            self._steps = until
        metrics = {name: value for name, value in metrics.items() if math.isfinite(value)}
        done = self._steps >= asked.train.env_steps or "diverged" in figures
        return {"env_steps": self._steps, **figures, "metrics": metrics, "done": done}

    def measured(self) -> dict[str, float]:
        """Evaluate the policy in validation corridors, which training and evaluation do not use."""
        asked = self._experiment
        env = dataclasses.replace(asked.env, split="validation")
        with unfinished(self.checkpoints()) as folder:
            checkpoint, policy = Path(folder, "checkpoint"), Path(folder, "policy")
            self.save_checkpoint(str(checkpoint))
            export_policy(asked, checkpoint, self._encoder, policy, {})
            agent = make_agent(str(policy), asked.evaluate.action)
            episodes = roll_out(agent, env, range(asked.own.episodes), SIDE_BY_SIDE)
        means = ("distance_m", episodes["distance_m"]), ("success_rate", episodes["success"])
        return {name: float(values.mean()) for name, values in means}

    def save_checkpoint(self, checkpoint_dir: str) -> None:
        """Write the state of the training."""
        Path(checkpoint_dir).mkdir(exist_ok=True)
        self._training.save_checkpoint(checkpoint_dir)
        write_json(Path(checkpoint_dir) / PROGRESS, {"env_steps": self._steps})

    def load_checkpoint(self, checkpoint: Any) -> None:
        """Continue from a checkpoint."""
        self._training.load_checkpoint(checkpoint)
        self._steps = int(read_json(Path(checkpoint) / PROGRESS)["env_steps"])

    def cleanup(self) -> None:
        """Stop the training and free its resources."""
        self._training.stop()
