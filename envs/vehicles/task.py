"""Task: reward of a control step, and end of an episode.

`env.task` names a row of `envs.config.TASKS`. The default is "corridor", the paper's task: metres of progress
along y, +100 at the goal line, -100 at a contact, and a time limit (appendix D.1.1). The compiled step judges
this task itself. Any other row is the location, "module:attribute", of a compiled function:

    @numba.njit
    def judge(vehicle): ...

It is called after each control step with the vehicle's `envs.vehicles.step.VEHICLE` record, which holds the
results of the task "corridor": last and current position, velocity, the clock, `reward`, `success`,
`collision` and `truncated`. The function may change the last four. A vehicle always stops at contact. A
plug-in adds a row, `TASKS["gentle"] = "my_module:judge"`.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numba

from core.places import resolve
from envs.config import TASKS
from envs.vehicles.step import BAD_REWARD, GOOD

Judge = Callable[..., None]


def judge_of(task: str) -> Judge | None:
    """Return the function that judges the steps of a task; None for "corridor", which needs no call."""
    return resolve(TASKS[task]) if TASKS[task] else None


@lru_cache(maxsize=16)
def loop_over(judge: Judge) -> Callable[..., None]:
    """Return the compiled loop that judges the active vehicles, from VEHICLE (B,) and bool (B,)."""

    @numba.njit(error_model="numpy")
    def judge_all(rows: Any, active: Any) -> None:
        for row in range(rows.size):
            if active[row] and rows[row].problem == GOOD:
                judge(rows[row])
                ended = rows[row].success or rows[row].collision
                rows[row].truncated = rows[row].truncated and not ended
                rows[row].over = ended or rows[row].truncated
                if not abs(rows[row].reward) < float("inf"):
                    rows[row].problem, rows[row].over = BAD_REWARD, True

    return judge_all
