"""Folders that sweeps leave, and published trainings, made of constructed episodes and curves."""

import dataclasses
import itertools
import json

import numpy as np

from jobs.config.config import parse
from jobs.rollout.episodes import EPISODE
from jobs.rollout.table import LABELS, write_episodes
from jobs.rollout.tasks import text_of
from jobs.study.plan import axes_of, baselines_of, same_simulations
from jobs.study.trainings import seeds_of
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


def named(at):
    """A condition as files have it."""
    return [at[0], text_of(at[1])]


def write_ablation(folder, exp, failed):
    """Leave the study of an experiment in `folder`, 14 episodes of each training and condition; returns it.

    Args:
        folder: Where.
        exp: The experiment.
        failed: How many episodes fail, by group, axis, value and seed.
    """
    config = parse(compose(f"+exp={exp}"))
    axes = axes_of("poles_eval", config.own.axes)
    env = dataclasses.replace(config.env, scene="poles_eval", split="eval")
    groups = {name: seeds_of(config, name) for name in config.own.variants}
    baselines, same = baselines_of(env, axes), same_simulations(env, axes)
    about = {
        **ABOUT, "run": f"{exp}-short-s0-1", "exp": exp, "groups": groups, "trials": 14, "met": [],
        "axes": {axis: {text_of(at): own for at, own in points.items()} for axis, points in axes.items()},
        "exactness": [],
        "compared": [{"condition": named(at), "baseline": named(baselines[at]), "same_as": named(same[at])}
                     for at in baselines],
    }  # fmt: skip
    rows = {}
    for (axis, value), (group, seeds) in itertools.product(baselines, groups.items()):
        for seed in seeds:
            episodes = np.zeros(14, EPISODE)
            episodes["seed"] = np.arange(14)
            episodes["success"] = (np.arange(14) + 3 * seed) % 14 >= failed(group, axis, value, seed)
            episodes["distance_m"] = np.where(episodes["success"], 100.0, 40.0)
            rows[axis, text_of(value), group, str(seed)] = episodes
    folder.mkdir(parents=True, exist_ok=True)
    write_episodes(folder / "episodes.csv", LABELS, rows)
    (folder / "about.json").write_text(json.dumps(about))
    return folder
