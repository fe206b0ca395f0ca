"""Where the gradients of large networks are computed: `cluster.device`, handed to the processes of a job.

It travels in the environment, as the number of threads does, and not in RLlib's settings: Tune continues a
training only under the settings that it began with, and one that was begun on a GPU may end on a processor.
"""

import os

LEARNER_DEVICE = "EVADE_LEARNER_DEVICE"


def device_variables(device: str) -> dict[str, str]:
    """Return the environment variables that name the device to the processes of a job."""
    return {LEARNER_DEVICE: device}


def learner_device() -> str:
    """Return this process's device, as torch names it."""
    return os.environ.get(LEARNER_DEVICE, "cpu")
