"""What a job's simulation asks of its events, and what it achieves: said, and logged with the run."""

from envs.config import EnvConfig
from envs.event_error import measure_event_error
from jobs.run.progress import console


def achieved(config: EnvConfig) -> dict[str, float]:
    """Measure the event error of a simulation, say it, and return it for the tracker.

    A camera that follows the paper's two-frame difference is measured against one that
    remembers, so its error is what that difference loses; the tolerance does not bind it.
    """
    accuracy = measure_event_error(config)
    asked = config.fidelity.tolerance
    text = (
        f"Event error in {config.scene}: {accuracy.error:.1%} (asked: at most {asked:.1%}), "
        f"{accuracy.renders:.1f} renders a step"
    )
    if config.camera.memory != "reference":
        text += f"; memory={config.camera.memory} is the cause of most of it"
    elif accuracy.error > asked:
        text += "; more than asked: lower fidelity.max_step_m, or raise fidelity.samples"
    console.print(text, markup=False)
    return {"sim/event_error": accuracy.error, "sim/renders_per_step": accuracy.renders}
