"""The space of a search: convert it for Tune, check it, and build the configurations of trials."""

import copy
import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import Any

from ray import tune

from jobs.config.config import Config, ConfigError, as_dict, parse
from jobs.config.env_keys import OPEN_KEYS, fields_of, flat_env
from jobs.run.identity import TRAINED_BY
from jobs.training.pretrain import evae_settings
from models.kinds import KINDS

# Keys that cannot be searched: names, settings that do not affect a training, and settings that must be equal
# for trials to be comparable.
FIXED = {*fields_of(Config), "search", "exp", "budget"} - ({*TRAINED_BY} - {"exp", "budget"})
FIXED_KEYS = ("train.env_steps", "algo.num_env_runners", "algo.lr_schedule")


def search_space(space: Mapping[str, Any]) -> dict[str, Any]:
    """Return the space for Tune; listed values are encoded as JSON, so that a value may itself be a list."""
    return {key: _domain(values) for key, values in space.items()}


def _domain(values: Any) -> Any:
    if isinstance(values, list):
        return tune.choice([json.dumps(value) for value in values])
    low, high = values["low"], values["high"]
    if isinstance(low, int) and isinstance(high, int):
        return (tune.lograndint if values.get("log") else tune.randint)(low, high + 1)
    return (tune.loguniform if values.get("log") else tune.uniform)(low, high)


def sampled(settings: Mapping[str, Any], space: Mapping[str, Any]) -> dict[str, Any]:
    """Encode the settings of a trial as Tune draws them; the inverse of `read_settings`."""
    return {
        key: json.dumps(value) if isinstance(space[key], list) else value for key, value in settings.items()
    }


def read_settings(sampled: Mapping[str, Any]) -> dict[str, Any]:
    """Decode the settings of a trial that Tune has drawn."""
    return {key: json.loads(value) if isinstance(value, str) else value for key, value in sampled.items()}


def with_settings(config: Config, settings: Mapping[str, Any]) -> Config:
    """Return the configuration of a trial: some settings replaced, without additional processes.

    Raises:
        ConfigError: A setting is unknown, or its value is invalid.
    """
    values: dict[str, Any] = copy.deepcopy(as_dict(config))
    values["algo"]["num_env_runners"] = 0
    for key, value in settings.items():
        *groups, name = key.split(".")
        inner: Any = values
        for group in groups:
            inner = inner.setdefault(group, {}) if key.startswith(OPEN_KEYS) else inner.get(group)
            if not isinstance(inner, dict):
                raise ConfigError(f"{key}: no such key, got {value!r}")
        inner[name] = value
    return parse(values)


def space_errors(config: Config) -> Iterator[str]:
    """Yield one line for each key that cannot be searched, and for each invalid value."""
    for key, values in config.own.space.items():
        if key.partition(".")[0] in FIXED or key in FIXED_KEYS:
            yield f"search.space: {key} must be the same for all trials"
            continue
        for value in extremes(values):
            try:
                with_settings(config, {key: value})
            except ConfigError as error:
                yield f"search.space: {error}"


def extremes(values: Any) -> list[Any]:
    """Return all values of a list, or the ends of a range."""
    return values if isinstance(values, list) else [values["low"], values["high"]]


def encoder_facts(config: Config) -> dict[str, Any] | None:
    """Return the settings that determine a frozen encoder; None if the model has none.

    Trials with equal settings share an encoder.
    """
    if not KINDS[config.model.name].encoder:
        return None
    parts = {name: dataclasses.asdict(getattr(config, name)) for name in ("collect", "pretrain")}
    evae = dataclasses.asdict(evae_settings(config))
    return {**flat_env(config.env), **parts, "evae": evae, "seed": config.seed, "init": config.train.init}
