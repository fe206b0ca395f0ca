"""What runs start from and leave behind: planned sweeps, encoder files, runs in a tracking store."""

import dataclasses

import torch
from ray.train._internal.storage import StorageContext

from envs.config import sensor_settings, settings_hash
from jobs.rollout.policies import read_policy
from jobs.study.plan import plan_study
from jobs.tracking.tracker import open_store
from jobs.training.policy import policy_about, policy_spec
from jobs.training.pretrain import evae_settings
from models.encoder.evae import EventVAE
from models.encoder.weights import save_encoder
from models.policy import save_policy
from models.policy.networks import build_networks
from models.policy.policy import NETWORKS


def planned(config, *agents):
    return plan_study(config, [read_policy(agent) for agent in agents])


def in_store(config, tmp_path):
    return dataclasses.replace(
        config, tracking=dataclasses.replace(config.tracking, uri=f"sqlite:///{tmp_path}/m.db")
    )


def tracked_sweeps(config, kind="condition", parent="sweep"):
    """Client, and the children of a kind by name of each sweep's parent run, or of each of another kind."""
    client, experiment = open_store(config.tracking.uri, config.tracking.experiment)
    parents = client.search_runs([experiment], f"tags.kind = '{parent}'")
    below = "tags.`mlflow.parentRunId` = '{}'"
    children = {
        run.info.run_id: client.search_runs(
            [experiment], f"{below.format(run.info.run_id)} and tags.kind = '{kind}'"
        )
        for run in parents
    }
    return client, {parent: {run.info.run_name: run for run in runs} for parent, runs in children.items()}


def trial_storage(folder, filesystem=None):
    """Where Tune keeps a trial: folder / "train" / "trial", of the local file system or another."""
    return StorageContext(str(folder), "train", storage_filesystem=filesystem, trial_dir_name="trial")


def write_networks(folder, config):
    """The file of the networks of a policy without an encoder."""
    spec = policy_spec(config)
    return save_policy(folder, build_networks(spec, seed=7), spec, policy_about(config)) / NETWORKS


def write_encoder(folder, config):
    torch.manual_seed(0)
    sensor = sensor_settings(config.env)
    evae = EventVAE.of(evae_settings(config))
    for parameter in evae.ecn.parameters():  # random weights see little; make latents differ
        parameter.data.mul_(1.5)
    path = folder / "encoder.safetensors"
    about = {"sensor": sensor, "sensor_hash": settings_hash(sensor), "figures": {"reconstruction_step": 0.5}}
    save_encoder(path, evae.freeze(), about)
    return path
