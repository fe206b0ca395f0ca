"""Reject settings of a command line that a resumed run would ignore, because its folder stores its own."""

from collections.abc import Collection
from pathlib import Path

from jobs.config.config import Config, ConfigError, as_dict
from jobs.config.flat import flat
from jobs.run.folder import reopen
from jobs.run.identity import TRAINED_BY

# For this job, `resume` names a study to publish; the settings are compared with the study's.
READS_STUDIES = "report"


def check_resumed(config: Config, given: Collection[str]) -> None:
    """Check that no key of a command line is ignored because `resume` names a run folder.

    Args:
        config: The command's configuration.
        given: The keys that the command line gives, such as "algo.lr", or a whole section, such as "algo".

    Raises:
        ConfigError: With a line for each key whose stored value differs; or as `reopen`.
    """
    if config.resume is None or config.job == READS_STUDIES:
        return
    run = reopen(Path(config.resume), config)
    asked, stored = dict(flat(as_dict(config))), dict(flat(as_dict(run.config)))
    lines = []
    for key in dict.fromkeys([*asked, *stored]):
        named = any(key == one or key.startswith(f"{one}.") for one in given)
        if named and key.partition(".")[0] in TRAINED_BY and asked.get(key) != stored.get(key):
            rule = f"must be {stored.get(key)!r}, as stored in {config.resume}, got {asked.get(key)!r}"
            lines.append(f"{key}: {rule}; leave it out, or leave out resume for a run of its own")
    if lines:
        raise ConfigError("\n".join(lines))
