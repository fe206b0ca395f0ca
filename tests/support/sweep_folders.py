"""Folders that sweeps leave, and published trainings, made of constructed episodes and curves."""

import dataclasses
import itertools
import json

import numpy as np

from envs.config import EnvConfig
from jobs.analysis.plots import Curve
from jobs.config.config import parse
from jobs.config.env_keys import flat_env
from jobs.evaluation.group_stats import LABELS
from jobs.evaluation.sweep_plan import axes_of, baselines_of, same_simulations
from jobs.rollout.episodes import EPISODE, write_episodes
from jobs.run.files import write_json
from jobs.studies.ablation.ablation import seeds_of
from jobs.tools.curves import as_csv
from models.policy.policy import MANIFEST
from tests.support.configs import compose
from tests.support.episodes import flights

ABOUT = {
    "run": "robustness-short-s0-1",
    "identity": "abc",
    "command": "python -m platform.launch +exp=robustness",
    "commit": "c0ffee",
    "evaluated_at": ["c0ffee"],
    "date": "2026-01-02",
    "scene": "poles_eval",
    "trials": 20,
    "reference": "event_columns",
    "action": "stochastic",
    "groups": {"bytestream": [0, 1, 2], "event_image": [0], "oracle": [None]},
    "exactness": [
        {"condition": ["sparsity", "0.5"], "asked": 0.05, "event_error": 0.0163, "renders_per_step": 5.0}
    ],
    "axes": {
        "nominal": {"poles_eval": {}},
        "sparsity": {"0.2": {"faults.sparsity": 0.2}, "0.5": {"faults.sparsity": 0.5}},
    },
    "compared": [
        {"condition": at, "baseline": ["nominal", "poles_eval"], "same_as": at}
        for at in (["nominal", "poles_eval"], ["sparsity", "0.2"], ["sparsity", "0.5"])
    ],
    "met": [["sparsity", "0.5", "bytestream"]],
}
KINDS = {
    "lost": "faults.event_dropout",
    "displaced": "faults.displaced",
    "flipped": "faults.flipped",
    "invented": "faults.background_activity",
    "jittered": "camera.latency_jitter_us",
}


def write_sweep(folder):
    """Leave a sweep of three groups in `folder`; dead pixels fire none, `oracle` sees none; returns it."""
    won = {"bytestream": 16, "event_image": 4, "oracle": 20}
    flown = {
        (axis, value, group, "" if seed is None else str(seed)): flights(won[group])
        for axis, points in ABOUT["axes"].items()
        for value in points
        for group, seeds in ABOUT["groups"].items()
        for seed in seeds
    }
    for (axis, value, group, _), rows in flown.items():
        working = 1.0 - ABOUT["axes"][axis][value].get("faults.sparsity", 0.0)
        rows["events_per_step"] *= 0.0 if group == "oracle" else working
    write_episodes(folder / "episodes.csv", LABELS, flown)
    (folder / "about.json").write_text(json.dumps(ABOUT))
    return folder


def write_shipped(folder, before=""):
    """Leave learning curves in `folder`, of policies that are there, named `before` first; returns it."""
    ends = {"bytestream": (0.8, 0.81), "event_image": (0.4, 0.41)}
    steps = np.array([0.0, 500_000.0])
    curves = [Curve(f"{before}{exp}", seed, steps, np.array([0.0, end]), steps)
              for exp, both in ends.items() for seed, end in enumerate(both)]  # fmt: skip
    for curve in curves:
        write_json(folder / f"{curve.exp}-s{curve.seed}" / MANIFEST, {})
    (folder / "curves.csv").write_text(as_csv(curves))
    return folder


def write_study(folder):
    """Leave a dose response of two groups: one fails under invented events, one never; returns the folder.

    Beside it are its plan, its simulation, and what is published of its groups, see `study_places`.
    """
    axes = {"nominal": {"poles_eval": {}}}
    axes |= {kind: {str(one): {key: one} for one in (0.1, 0.2)} for kind, key in KINDS.items()}
    places = [[axis, value] for axis, points in axes.items() for value in points]
    nominal = places[0]
    about = {
        "run": "dose_response-short-s0-1", "exp": "dose_response", "identity": "abc", "command": "command",
        "commit": "c0ffee", "evaluated_at": ["c0ffee"], "date": "2026-01-02", "scene": "poles_eval",
        "trials": 14, "reference": "steady", "action": "stochastic", "axes": axes,
        "groups": {"weak": list(range(6)), "steady": list(range(6))},
        "compared": [{"condition": at, "baseline": nominal, "same_as": at} for at in places],
        "met": [],
    }  # fmt: skip
    rows = {}
    for axis, value in places:
        for group, seed in ((group, seed) for group, seeds in about["groups"].items() for seed in seeds):
            episodes = np.zeros(14, EPISODE)
            episodes["seed"] = np.arange(14)
            lost = 12 if (axis, group) == ("invented", "weak") else 1
            episodes["success"] = (np.arange(14) + 3 * seed) % 14 >= lost
            rows[axis, value, group, str(seed)] = episodes
    write_episodes(folder / "episodes.csv", LABELS, rows)
    (folder / "about.json").write_text(json.dumps(about))
    write_plan(folder.parent, about)
    return folder


def write_claims(folder, lost=(), exp="taught_claims", trainings=3):
    """Leave a study of the paper's claims in `folder`, whose trainings lose none or one of 14; returns it.

    Args:
        folder: Where.
        lost: Group, axis, value and how many episodes more each training loses there.
        exp: Its experiment.
        trainings: Of each group.
    """
    more = {tuple(place): count for *place, count in lost}

    def failed(group, axis, value, seed):
        return seed % 2 + more.get((group, axis, value), 0)

    return write_ablation(folder, exp, failed, trainings)


def write_ablation(folder, exp, failed, trainings=None):
    """Leave the study of an experiment in `folder`, 14 episodes of each training and condition; returns it.

    Args:
        folder: Where.
        exp: The experiment.
        failed: How many episodes fail, by group, axis, value and seed.
        trainings: Of each group; None: all.
    """
    config = parse(compose(f"+exp={exp}"))
    axes, env = axes_of(config.sweep), dataclasses.replace(config.env, scene="poles_eval", split="eval")
    groups = {name: seeds_of(config, name)[:trainings] for name in config.ablation.variants}
    baselines, same = baselines_of(env, axes), same_simulations(env, axes)
    about = {
        **ABOUT, "run": f"{exp}-short-s0-1", "exp": exp, "axes": axes, "groups": groups,
        "trials": 14, "met": [], "exactness": [],
        "compared": [{"condition": at, "baseline": baselines[at], "same_as": same[at]} for at in baselines],
    }  # fmt: skip
    rows = {}
    for (axis, value), (group, seeds) in itertools.product(baselines, groups.items()):
        for seed in seeds:
            episodes = np.zeros(14, EPISODE)
            episodes["seed"] = np.arange(14)
            episodes["success"] = (np.arange(14) + 3 * seed) % 14 >= failed(group, axis, value, seed)
            episodes["distance_m"] = np.where(episodes["success"], 100.0, 40.0)
            rows[axis, value, group, str(seed)] = episodes
    folder.mkdir(parents=True, exist_ok=True)
    write_episodes(folder / "episodes.csv", LABELS, rows)
    (folder / "about.json").write_text(json.dumps(about))
    return folder


def write_plan(run, about):
    """Leave the plan of a dose response, its published policies and its simulation in a run folder."""
    axes = {kind: {key: [0.1, 0.2]} for kind, key in KINDS.items()}
    plan = {name: about[name] for name in ("scene", "trials", "reference")}
    plan |= {"policies": list(about["groups"]), "axes": axes}
    (run / "plan.yaml").write_text(json.dumps(plan))  # JSON is YAML
    write_json(run / "config.json", flat_env(EnvConfig()))
    for group, seeds in about["groups"].items():
        for seed in seeds:
            write_json(run / "published" / f"{group}-s{seed}" / MANIFEST, {})


def study_places(study):
    """Arguments of `write_dose_response` that name what lies beside a study."""
    return {"pretrained": study.parent / "published", "plan": study.parent / "plan.yaml"}
