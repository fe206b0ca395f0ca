"""Where episodes ended in contact, seen from above."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jobs.analysis.colours import INK, MUTED
from jobs.analysis.plots import panel_grid, style_of

MAX_ACROSS = 2  # panels side by side


def contact_map(
    ends: Mapping[str, tuple[np.ndarray, np.ndarray]], length_m: float, half_width_m: float
) -> Figure:
    """Draw where episodes of each group ended in contact.

    Args:
        ends: Group -> EPISODE without any change, and EPISODE under all changes in the same scene.
        length_m: Where the goal line is [m].
        half_width_m: Where the walls are [m].
    """
    figure, panels = panel_grid(len(ends), MAX_ACROSS, (6.6, 2.3), (0.0, 0.7), sharex=True, sharey=True)
    for panel, (group, (unchanged, changed)) in zip(panels, ends.items(), strict=True):
        _draw_contacts(panel, group, unchanged, changed)
        panel.hlines([-half_width_m, half_width_m], 0, length_m, color=INK, lw=1.5)
        panel.vlines(length_m, -half_width_m, half_width_m, color=MUTED, lw=1.2, ls=":")
        panel.set(xlim=(-2, length_m + 2), ylim=(half_width_m + 1.5, -half_width_m - 1.5))
    figure.supxlabel(
        "y, along the corridor [m]; large dots: nothing changed, small dots: with changes in the same scene",
        fontsize=8,
    )
    figure.supylabel("x, to the right [m]", fontsize=8)
    return figure


def _draw_contacts(panel: Axes, group: str, unchanged: np.ndarray, changed: np.ndarray) -> None:
    """Draw the contacts of one group as dots, large where nothing was changed."""
    colour, usual, others = style_of(group)[0], *(rows[rows["collision"]] for rows in (unchanged, changed))
    panel.scatter(usual["distance_m"], usual["x_m"], s=26, alpha=0.95, color=colour, edgecolors="white",
                  lw=0.5, zorder=3)  # fmt: skip
    panel.scatter(others["distance_m"], others["x_m"], s=7, alpha=0.25, color=colour, lw=0, zorder=2)
    counts = f"unchanged {len(usual)} of {len(unchanged)}, changed {len(others)} of {len(changed)}"
    panel.set_title(f"{group}: contacts {counts}", loc="left", fontsize=9, color=INK)
    panel.spines[:].set_visible(False)
    panel.tick_params(labelsize=8, labelbottom=True, labelleft=True)
