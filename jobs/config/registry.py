"""The jobs that `job=NAME` can run.

A job is two files. `conf/job/NAME.yaml` names it and has the values of its settings. The module NAME of a
room of jobs/ (or of research/) has `run(config)` and, if the job has settings of its own, their class
`Settings`. Nothing else lists jobs: help, dashboard and the tables of keys are derived from these two files.
"""

import importlib
import sys
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
HOME = ROOT if (ROOT / "conf").is_dir() else Path(sys.prefix) / "share" / "evade"  # in an installed wheel
CONF = HOME / "conf"


class Job(NamedTuple):
    """A job.

    Attributes:
        module: Module whose `run(config)` does the job.
        file: Its file in conf/job.
    """

    module: str
    file: Path

    @property
    def summary(self) -> str:
        """Return the first line of the module's docstring, without importing the module."""
        file = ROOT.joinpath(*self.module.split(".")).with_suffix(".py")
        with file.open(encoding="utf-8") as text:
            return text.readline().strip().strip('"').rstrip(".")

    def values(self) -> dict[str, Any]:
        """Return the content of its file."""
        import yaml  # imported late: the launcher reports missing packages

        return dict(yaml.safe_load(self.file.read_text(encoding="utf-8")))

    def own_keys(self) -> list[str]:
        """Return the names of the job's own settings."""
        values = self.values()
        return list(values.get(values["job"], ()))

    def settings(self) -> type[Any] | None:
        """Import the module and return the class of the job's own settings; None if it has none."""
        return getattr(importlib.import_module(self.module), "Settings", None)


def module_of(name: str) -> str | None:
    """Return the module of a job: jobs.NAME, jobs.ROOM.NAME or jobs.ROOM.NAME.NAME, or the same in research.

    Return None if there is none: an installation may lack research/.

    Raises:
        LookupError: If there is more than one.
    """
    places = (
        f"jobs/{name}.py",
        f"jobs/*/{name}.py",
        f"jobs/*/{name}/{name}.py",
        f"research/{name}.py",
        f"research/{name}/{name}.py",
    )
    found = [path for place in places for path in ROOT.glob(place)]
    if len(found) > 1:
        raise LookupError(f"job {name}: must have one module {name}.py, got {', '.join(map(str, found))}")
    return ".".join(found[0].relative_to(ROOT).with_suffix("").parts) if found else None


JOBS = {
    file.stem: Job(module, file)
    for file in sorted((CONF / "job").glob("*.yaml"))
    if (module := module_of(file.stem)) is not None
}
