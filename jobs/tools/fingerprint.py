"""Compare this machine's results with the published ones: a hash for each stage of a training.

Run: evade fingerprint
Expect: half a minute on one core; "equal", or the first stage that differs and exit status 1. Later stages
start from the output of earlier ones. If no fingerprint is published yet, this one is written.
"""

import dataclasses
import hashlib
import json
import logging
import os
import warnings
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from typing import Any, cast

import numpy as np
import torch
from llvmlite.binding import get_host_cpu_name

from envs.config import FaultsConfig
from envs.raycast import RaycastRenderer
from envs.recordings import Recording
from envs.scene import make_scene
from jobs.analysis.tables import show_table
from jobs.config.algorithms import AlgoConfig, ImitationConfig
from jobs.config.config import Config
from jobs.rollout.agents import make_agent
from jobs.rollout.episodes import roll_out
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import RunError, write_atomic
from jobs.run.libraries import processor
from jobs.run.progress import console
from jobs.run.provenance import REPOSITORY
from jobs.run.torch_threads import torch_threads
from jobs.training.algorithms import algorithm_of
from jobs.training.collect import record
from jobs.training.policy import policy_spec
from jobs.training.pretrain import THREADS, EvaeTraining
from models.encoder.evae import EventVAE
from models.encoder.table import EncoderTable
from models.kinds import DenseModel, EvaeSettings, FixedModel, Model
from models.policy.networks import build_networks

PUBLISHED = REPOSITORY / "docs" / "data" / "fingerprints.json"
FLAGS = ("avx2", "fma", "avx512f", "avx512vl", "avx512_bf16", "amx_tile")
PACKAGES = ("numpy", "numba", "llvmlite", "torch", "scipy")
SCENES = ("poles", "shape_change", "texture_change", "dynamic")
STEPS = 64  # control steps in each scene, and in each round of PPO
ITERATIONS = 4  # of each encoder's training
ENCODERS = {
    "": EvaeSettings("bytestream", 64, 64, 256, 32, "batch", "occupancy", 1024, "additive"),
    ", rotated and signed": EvaeSettings("bytestream", 64, 64, 64, 8, "batch", "signed", 256, "eventnet"),
    ", convolutions": EvaeSettings("event_image_vae", 64, 64, 64, 8, "none", "counts", 1, "none"),
}
POLICIES: dict[str, Model] = {
    "dense": DenseModel("event_columns", 3, [64, 64]),
    "sets": FixedModel("event_set", 3),
    "convolutions": FixedModel("event_image", 3),
}
TAUGHT = ImitationConfig(temperature=0.003, guided_batches=1, fit_steps=4, final_steps=4, keep_mb=16.0)
POLICY, CORRIDORS = "bytestream-s0", (3, 4)
Arrays = Iterable[Any]


class FingerprintError(RunError):
    """A stage whose digits differ from the published ones."""


def run(config: Config) -> dict[str, str]:
    """Compute and print the fingerprint, and compare it with the published one.

    Raises:
        FingerprintError: A stage differs; the message names the first.
    """
    console.print("\n".join(f"{name}: {value}" for name, value in machine().items()))
    found = {name: digest(arrays) for name, arrays in stages(config)}
    if not PUBLISHED.is_file():
        first = {"processors": [machine()["Processor"]], "versions": versions(), "stages": found}
        write_atomic(PUBLISHED, json.dumps(first, indent=2) + "\n")
    published = json.loads(PUBLISHED.read_text())
    rows = [(name, one, published["stages"].get(name, "none")) for name, one in found.items()]
    show_table("Fingerprint", ("Stage", "Here", "Published"), rows, 1, None)
    differ = [name for name, here, there in rows if here != there]
    if differ:
        versions_differ = "" if published["versions"] == versions() else "; so do the versions of packages"
        raise FingerprintError(f"the digits differ from stage {differ[0]!r} on{versions_differ}")
    console.print("equal")
    return found


def machine() -> dict[str, str]:
    """Describe this processor and the versions of the numerical packages."""
    known = processor()
    flags = set(known.get("flags", "").split())
    name = (
        f"{known.get('vendor_id', os.uname().machine)} {known.get('model name', '')} ({get_host_cpu_name()})"
    )
    return {
        "Processor": name,
        "Instructions": " ".join(flag for flag in FLAGS if flag in flags),
        "Packages": ", ".join(f"{package} {number}" for package, number in versions().items()),
    }


def versions() -> dict[str, str]:
    """Return the versions of the numerical packages."""
    return {package: version(package).partition("+")[0] for package in PACKAGES}


def digest(arrays: Arrays) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of all arrays in turn."""
    whole = hashlib.sha256()
    for array in arrays:
        whole.update(np.ascontiguousarray(array).tobytes())
    return whole.hexdigest()[:16]


def stages(config: Config) -> Iterator[tuple[str, Arrays]]:
    """Yield the stages in the order of a training: name, and the arrays that the stage computes."""
    yield "pictures", pictures()
    recording = recorded(config)
    yield "events", [recording.events, *recording.index.values()]
    for name, model in POLICIES.items():
        spec = policy_spec(dataclasses.replace(config, model=model))
        yield f"first weights: {name}", weights(build_networks(spec))
    for name, settings in ENCODERS.items():
        training = EvaeTraining(settings, recording, config.pretrain, (0, 2))
        yield f"first weights: encoder{name}", weights(training.evae)
        with torch_threads(THREADS):
            for iteration in range(ITERATIONS):
                training.step(iteration)
        yield f"encoder{name}", weights(training.evae)
        if settings.variant == "bytestream":
            yield f"table{name}", tabulated(training.evae)
    for name, model in POLICIES.items():
        yield f"PPO: {name}", learnt(dataclasses.replace(config, model=model))
    algo = dataclasses.replace(cast(AlgoConfig, config.algo), imitation=TAUGHT)
    yield "imitation", learnt(dataclasses.replace(config, algo=algo, model=POLICIES["dense"]))
    yield "episodes", [roll_out(make_agent(str(PRETRAINED / POLICY), "stochastic"), config.env, CORRIDORS)]


def pictures() -> Iterator[np.ndarray]:
    """Yield a picture of each scene, float32 (H, W)."""
    for name in SCENES:
        yield RaycastRenderer(make_scene(name, np.random.default_rng(0)), 64, 64).render(0.1, 5.0, 2.0, 0.05)


def recorded(config: Config) -> Recording:
    """Record a few steps of random flight in each scene, with false events and dead pixels."""
    faults = FaultsConfig(sparsity=0.1, background_activity=0.1)
    envs = [
        dataclasses.replace(config.env, scene=scene, faults=faults, observation="events") for scene in SCENES
    ]
    return record([(env, STEPS) for env in envs], 0, lambda _: None)[0]


def weights(network: torch.nn.Module) -> list[np.ndarray]:
    """Return all parameters and buffers, in the order of the module."""
    return [value.detach().numpy() for value in network.state_dict().values()]


def tabulated(evae: EventVAE) -> list[np.ndarray]:
    """Return the arrays of an encoder's lookup table."""
    table = EncoderTable.from_evae(evae.eval())
    return [table.features, table.embedding]


def learnt(config: Config) -> list[np.ndarray]:
    """Return the weights of a policy after two updates of the experiment's learner."""
    torch.manual_seed(0)
    logging.getLogger("ray").setLevel(logging.ERROR)  # hide Ray's warnings about its own settings
    ppo = algorithm_of(config).build(config, None, None)
    with warnings.catch_warnings(action="ignore"):  # the previous stage registered the same environment
        runner = ppo.env_runner_cls(config=ppo, worker_index=0)
    learner = ppo.build_learner(env=runner.env)
    for count in (1, 2):
        learner.update(
            episodes=runner.sample(num_timesteps=STEPS),
            timesteps={"num_env_steps_sampled_lifetime": count * STEPS},
            num_epochs=2,
            minibatch_size=32,
        )
    runner.stop()
    return weights(learner.module["default_policy"].unwrapped())
