"""Write the tables that are generated from code and data into the pages, so that GitHub shows them, too.

Run from the repository root: python -m docs.tables [--check]
The result of the function NAME is written between `<!-- NAME -->` and `<!-- /NAME -->` of a page. With
--check nothing is written, and the command fails if a page is out of date.
"""

import ast
import csv
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

from docs.keys import tables as key_tables
from jobs.analysis.tables import markdown_table
from jobs.bench.bench_table import entries
from jobs.bench.bench_table import table as leaderboard
from jobs.bench.protocol import read_protocol
from jobs.run.files import write_atomic
from jobs.study.models import models_tables

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "docs" / "data"
MODULES = {
    "The world and its events": (
        "envs.corridor", "envs.config", "envs.scene", "envs.scene.layouts", "envs.scene.shapes",
        "envs.scene.obstacles", "envs.scene.moving", "envs.scene.textures", "envs.scene.range_scan",
        "envs.scene.planning",
        "envs.raycast", "envs.rasterize", "envs.events", "envs.events.faults", "envs.observations",
        "envs.state_observation", "envs.kinematics", "envs.vehicles.dynamics", "envs.vehicles.planning",
        "envs.vehicles.task", "envs.fidelity",
        "envs.event_error", "envs.recordings", "envs.recordings.video",
    ),
    "From events to actions": (
        "models.kinds", "models.encoder.embedding", "models.encoder.context", "models.encoder.evae",
        "models.encoder.table", "models.encoder.weights", "models.encoder.event_images",
        "models.encoder.finetuned", "models.policy", "models.policy.features", "models.policy.memory",
        "models.policy.networks", "models.policy.event_set", "models.policy.onnx",
    ),
    "What both use": ("core.neighbour_filter", "core.pictures", "core.files"),
    "Experiments": (
        "jobs.config.config", "jobs.config.schema", "jobs.config.conditions", "jobs.rollout.agents",
        "jobs.rollout.episodes", "jobs.rollout.policies", "jobs.rollout.recorded",
        "jobs.analysis.statistics", "jobs.analysis.tables", "jobs.tracking.tracker",
        "jobs.tracking.child_runs", "jobs.tracking.model_registry",
    ),
}  # fmt: skip
# Heading of the README's table -> the condition; then its rows: study and group -> name.
CONDITIONS = {
    "nominal": ("nominal", "poles_eval"),
    "45 Hz": ("control_hz", "45"),
    "50 % dead pixels": ("sparsity", "0.5"),
    "10 % false events": ("background_activity", "0.1"),
    "new shapes": ("world", "shape_change"),
    "new textures": ("world", "texture_change"),
}
POLICIES = {
    ("robustness", "bytestream_late"): "`bytestream_late`: imitation, domain randomization, delays",
    ("robustness", "bytestream_hold"): "`bytestream_hold`: the same without delays",
    ("taught_claims", "bytestream"): "`bytestream`: imitation",
    ("taught_claims", "event_image"): "`event_image`: imitation",
    ("ppo_claims", "bytestream"): "`bytestream`: PPO",
    ("ppo_event_set", "event_set"): "`event_set`: PPO",
    ("ppo_claims", "event_image"): "`event_image`: PPO",
    ("ppo_paper", "bytestream_paper"): "`bytestream_paper`: the appendix read literally",
    ("body_conditions", "body_hold"): "`body_hold`: imitation, a [point mass](docs/vehicles.md) at 10 m/s",
}


def source_of(module: str) -> Path:
    """Return the file of a module, relative to the repository root."""
    path = Path(*module.split("."))
    return path.with_suffix(".py") if (ROOT / path.with_suffix(".py")).is_file() else path / "__init__.py"


def api_table() -> str:
    """Return the modules of the API with the first line of each docstring, linked to their sources."""
    text = []
    for section, modules in MODULES.items():
        rows = []
        for module in modules:
            said = ast.get_docstring(ast.parse((ROOT / source_of(module)).read_text())) or ""
            rows.append((f"[`{module}`](../{source_of(module)})", said.partition("\n")[0]))
        text += [f"## {section}\n", markdown_table(("module", "what it does"), rows, 2)]
    return "\n".join(text)


def modules_page() -> str:
    """Return the page from which the site generates a page for each module."""
    blocks = [
        f"{section}\n{'-' * len(section)}\n\n.. autosummary::\n   :toctree: api\n\n"
        + "\n".join(f"   {module}" for module in modules)
        for section, modules in MODULES.items()
    ]
    return "\n\n".join(["All modules\n===========", *blocks]) + "\n"


def layer_table() -> str:
    """Return the layers of each package, from the highest to the lowest, as import-linter checks them."""
    found = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    rows = []
    for contract in found:
        for package in contract.get("containers", ()):
            layers = (", ".join(f"`{name}`" for name in own.split(" | ")) for own in contract["layers"])
            rows.append((f"`{package}`", " > ".join(layers)))
    return markdown_table(("package", "layers"), rows, 2)


def success_table() -> str:
    """Return the README's table: success [%] of some groups under some conditions, means over seeds.

    Each group comes from its study with the most trainings and corridors.
    """
    rates: dict[tuple[str, ...], list[float]] = defaultdict(list)
    episodes: dict[str, str] = {}
    for study in dict.fromkeys(study for study, _ in POLICIES):
        with (DATA / f"{study}_trainings.csv").open() as file:
            for row in csv.DictReader(file):
                at = study, row["Group"], row["Axis"], row["Value"]
                rates[at].append(100 * float(row["success_rate"]))
                episodes[study] = row["episodes"]
    rows = []
    for (study, group), named in POLICIES.items():
        own = [rates[study, group, *at] for at in CONDITIONS.values()]
        cells = (f"{sum(one) / len(one):.0f}" for one in own)
        rows.append((named, f"{len(own[0])} x {episodes[study]}", *cells))
    return markdown_table(("policy", "seeds x corridors", *CONDITIONS), rows, 1)


def bench_table() -> str:
    """Return the leaderboard of part C of the benchmark, from the results in docs/data/bench."""
    folder = DATA / "bench"
    if not any(folder.glob("*.json")):
        return "No result yet."
    return leaderboard(entries(folder, read_protocol())["C"])


TABLES: dict[str, dict[str, Callable[[], str]]] = {
    "README.md": {"success": success_table},
    "docs/code.md": {"layers": layer_table},
    "docs/keys.md": {"keys": key_tables},
    "docs/benchmark.md": {"bench_C": bench_table},
    "docs/api.md": {"modules": api_table},
    "docs/models.md": {name: lambda name=name: models_tables()[name] for name in ("robustness", "taught")},  # type: ignore[misc]
}


def filled(text: str, name: str, table: str) -> str:
    """Return a page with a table inserted between its marks.

    Raises:
        ValueError: The page lacks the marks.
    """
    found = re.subn(
        f"(<!-- {name} -->\n).*?(<!-- /{name} -->)",
        lambda marks: f"{marks[1]}\n{table.strip()}\n\n{marks[2]}",
        text,
        flags=re.DOTALL,
    )
    if found[1] != 1:
        raise ValueError(
            f"the page must have <!-- {name} --> and <!-- /{name} --> once, got {found[1]} times"
        )
    return found[0]


def pages() -> dict[str, str]:
    """Return path -> up-to-date text of each page with tables."""
    found = {"docs/modules.rst": modules_page()}
    for page, tables in TABLES.items():
        text = (ROOT / page).read_text()
        for name, table in tables.items():
            text = filled(text, name, table())
        found[page] = text
    return found


def stale() -> list[str]:
    """Return the pages whose tables are out of date."""
    return [page for page, text in pages().items() if (ROOT / page).read_text() != text]


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit("\n".join(f"{page}: run python -m docs.tables" for page in stale()) or 0)
    for page, text in pages().items():
        write_atomic(ROOT / page, text)
