"""From nothing to a policy: collect, pretrain, train, evaluate (appendix B and D).

Run: python -m platform.launch +exp=bytestream
Expect: 4 to 8 minutes on 2 cores with budget=short; a table of success rates and
distances with intervals, the name of the policy in MLflow's model registry, and the command that
opens the dashboard. A policy without an event
VAE, such as +exp=event_columns, begins with its training. A stopped run continues where it
was when the same command is given again.
"""

from jobs.config.config import Config
from jobs.evaluation.evaluate import evaluate
from jobs.run.folder import open_run
from jobs.run.progress import console
from jobs.tracking.model_registry import register_training
from jobs.tracking.tracker import open_tracker
from jobs.training.inputs import check_inputs, prepare_inputs
from jobs.training.train import train


def run(config: Config) -> dict[str, float]:
    """Run every stage that the policy needs and that is not done yet, and return the evaluation's metrics."""
    check_inputs(config)
    folder = open_run(config)
    console.print(f"Run folder: {folder.path}")
    with open_tracker(folder.config, folder) as tracker:
        train(folder, prepare_inputs(folder, tracker), tracker.log)
        metrics = evaluate(folder, tracker)
        console.print(f"Registered: {register_training(tracker, folder.path)}")
        console.print(tracker.dashboard())
    return metrics
