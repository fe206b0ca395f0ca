"""Fly policies of several trainings through every condition, and say what each group bears (appendix D.3).

Run: python -m platform.launch +exp=robustness
Expect: about half a second of one core for each flight (7 for each training and condition); in the
run folder under `sweep/` a figure per axis, tables with intervals and every episode. All fly the
same corridors. A stopped sweep continues when the same command is given again: what was flown is
read back, never flown twice; what failed is tried again (`jobs.rollout.scheduler`).
"""

from typing import Any

from jobs.config.config import Config
from jobs.evaluation.sweep_plan import Sweep, find_entries, plan
from jobs.evaluation.sweep_report import report
from jobs.rollout.scheduler import fly_cells
from jobs.rollout.tasks import episodes_folder, read_kept
from jobs.run.folder import finish, locate_run, open_run
from jobs.run.progress import console
from jobs.tracking.tracker import open_tracker


def run(config: Config) -> dict[str, Any]:
    """Fly every cell that is not flown yet; report, and return each group's success rate by condition."""
    entries = find_entries(config, locate_run(config))
    folder = open_run(config)
    config = folder.config
    sweep = plan(config, entries)
    announce(sweep)
    with open_tracker(config, folder, key=f"sweep {sweep.identity[:8]}") as tracker:
        tracker.tags({"kind": "sweep", "groups": ", ".join(sweep.groups)})
        episodes, failed = fly_cells(config, folder.path / "sweep", sweep.cells, "Sweep")
        kept = {key: read_kept(episodes_folder(folder.path / "sweep"), key) for key in episodes}
        figures = report(config, folder, tracker, sweep, episodes, kept, failed)
        console.print(tracker.dashboard(), markup=False)
    return finish(folder, "sweep", figures)


def announce(sweep: Sweep) -> None:
    """Say who flies, and where a policy's own sensor replaces the configured one."""
    for group, trainings in sweep.groups.items():
        seeds = ", ".join(str(seed) for seed in trainings if seed is not None)
        console.print(f"Group: {group}" + (f" (training seeds {seeds})" if seeds else ""), markup=False)
    for agent, differ in sweep.differ.items():
        flown = ", ".join(f"{name} = {own!r} instead of {ours!r}" for name, (own, ours) in differ.items())
        console.print(f"Flown with its own sensor: {agent}: {flown}", markup=False)
