"""The jobs that `job=NAME` can run: which module does each, and what it is for."""

from typing import NamedTuple


class Job(NamedTuple):
    """One job.

    Attributes:
        module: Its `run(config)` does the job.
        summary: What comes of it, as the dashboard says it.
    """

    module: str
    summary: str


JOBS = {
    "pipeline": Job("jobs.pipeline", "From nothing to an evaluated policy"),
    "collect": Job("jobs.training.collect", "Recordings of flights, to pretrain on"),
    "pretrain": Job("jobs.training.pretrain", "An event VAE, whose frozen encoder a policy sees by"),
    "train": Job("jobs.training.train", "A policy trained by PPO"),
    "evaluate": Job("jobs.evaluation.evaluate", "A policy and its baselines in corridors never trained on"),
    "sweep": Job(
        "jobs.evaluation.sweep",
        "Policies at other rates and thresholds, in other worlds, with sensor faults",
    ),
    "report": Job("jobs.reporting.report", "The page of results, written from the newest sweep"),
    "demo": Job("jobs.evaluation.demo", "A film of one episode of a policy"),
    "replay": Job("jobs.tools.replay", "What a policy makes of a real camera's recording"),
    "video_events": Job("jobs.tools.video_events", "The events of a video, as a camera would report them"),
    "calibrate": Job("jobs.tools.calibrate.calibrate", "The settings of the camera that made a recording"),
    "sliding": Job("research.sliding.sliding", "What a probe of the simulation reads of a recording"),
    "replay_page": Job("jobs.tools.replay_page", "A page to scrub through recorded episodes"),
    "ship": Job("jobs.tools.publish", "The trained policies of models/pretrained, and how they learnt"),
    "trade": Job("jobs.measure.trade.trade", "What exactness costs from end to end"),
    "trade_simulator": Job("jobs.measure.simulator", "What exact events cost"),
    "trade_encoder": Job("jobs.measure.encoder.trade", "What an exact encoder costs"),
    "tune": Job("jobs.tools.search.search", "Which settings a training learns best with"),
    "ablation": Job("jobs.studies.ablation.ablation", "What each part of a recipe contributes"),
    "numerics": Job("jobs.studies.numerics.numerics", "What the numbers do at the ends of their ranges"),
    "fingerprint": Job("jobs.tools.fingerprint", "Whether this machine gives the published digits"),
    "probe": Job("research.probe.probe", "What a representation of events tells an agent"),
}
