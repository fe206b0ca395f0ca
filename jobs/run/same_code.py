"""Check that every machine of a cluster has the code and the packages of the driver."""

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from jobs.config.config import ConfigError
from jobs.config.plugins import digest_of, plugin_digests
from jobs.run.provenance import REPOSITORY

ROOMS = ("core", "envs", "models", "jobs")
PACKAGES = ("numba", "numpy", "torch")  # they affect results; Ray compares its own and Python's version
ANSWER_S = 600.0  # on a busy machine a worker takes minutes to start


def fingerprint() -> dict[str, str]:
    """Return what this process's results depend on: SHA-256 of the code and plug-ins, package versions."""
    files = [file for room in ROOMS for file in sorted((REPOSITORY / room).rglob("*.py"))]
    versions = {name: version(name) for name in PACKAGES}
    return {"evade": digest_of(files, REPOSITORY), **versions, **plugin_digests()}


def check_machines() -> None:
    """Check that each machine of the joined cluster that computes has the same code as this machine.

    Machines that join later are not checked; machines that are lost during the check are ignored.

    Raises:
        ConfigError: A machine has other versions, or none.
    """
    here = fingerprint()
    errors = differences(here, ask_machines())
    if errors:
        raise ConfigError("\n".join(f"cluster.address: {error}" for error in errors))


def ask_machines() -> dict[str, dict[str, str] | str]:
    """Return the address of each machine, and its fingerprint or the reason why it has none."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    task = ray.remote(num_cpus=0, max_retries=2)(fingerprint)
    asked = {
        node["NodeManagerAddress"]: task.options(
            scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        ).remote()
        for node in ray.nodes()
        if node["Alive"] and node["Resources"].get("CPU", 0) > 0
    }
    answers = {address: _answer(reference) for address, reference in asked.items()}
    return {address: answer for address, answer in answers.items() if answer is not None}


def _answer(reference: Any) -> dict[str, str] | str | None:
    """Return a machine's answer, or the reason why it cannot answer; None if the machine is lost."""
    import ray

    try:
        answer: dict[str, str] = ray.get(reference, timeout=ANSWER_S)
    except (ray.exceptions.RayTaskError, ray.exceptions.RaySystemError) as error:
        return str(error).strip().splitlines()[-1].strip()
    except ray.exceptions.GetTimeoutError:
        return f"no answer in {ANSWER_S:.0f} s"
    except ray.exceptions.RayError:
        return None
    return answer


def differences(here: Mapping[str, str], answers: Mapping[str, Mapping[str, str] | str]) -> list[str]:
    """Return one line for each machine that differs from this one, with the remedy."""
    errors = []
    for address, answer in answers.items():
        if isinstance(answer, str):
            errors.append(f"{address} cannot run this package ({answer}); install it there as it is here")
            continue
        other = [f"{name} {answer.get(name)} (here {mine})" for name, mine in here.items()
                 if answer.get(name) != mine]  # fmt: skip
        if other:
            rule = "must have the code and packages of this machine"
            errors.append(f"{address} {rule}, got {', '.join(other)}; install the same commit and lock file")
    return errors
