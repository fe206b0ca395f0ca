"""Pass `cluster.device`, on which large networks compute their gradients, to the processes of a job.

It is an environment variable, like the number of threads, and not a setting of RLlib: Tune resumes a training
only with the settings that it started with, and a training started on a GPU may be resumed on a CPU.
"""

import os

LEARNER_DEVICE = "EVADE_LEARNER_DEVICE"


def learner_device() -> str:
    """Return the device of this process by its name in torch."""
    return os.environ.get(LEARNER_DEVICE, "cpu")
