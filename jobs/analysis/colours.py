"""The colours of all plots and films."""

import numpy as np

from envs.observations import OFF_RGB, ON_RGB

INK, MUTED, GRID = "#1f2430", "#6b7280", "#e5e7eb"
BLACK, SLATE = "#111827", "#64748b"
BLUE, CYAN, GREEN, LIME = "#2563eb", "#0891b2", "#059669", "#65a30d"
AMBER, BROWN, RED, PINK, VIOLET = "#d97706", "#b45309", "#dc2626", "#db2777", "#9333ea"
GREYS = ("#9ca3af", "#6b7280", "#374151", "#111827")  # for comparisons, from light to dark
EVENTS = np.array([OFF_RGB, (21, 24, 31), ON_RGB])  # OFF, no event, ON
# Colours by what is drawn.
COLOURS = {
    # outcomes of episodes
    "goal": BLUE, "collision": RED, "time limit": BROWN,
    # settings of the encoder
    "precision": LIME, "time bins": VIOLET, "newest events": BROWN, "torch": RED, "chunks": GREEN,
    "context": CYAN, "default": BLACK,
    # codings of time, targets of the decoder, memory modes
    "additive": BLUE, "eventnet": AMBER, "none": MUTED,
    "occupancy": BLUE, "signed": AMBER, "aged": GREEN, "counts": PINK, "proximity": SLATE,
    "reference": BLUE, "frame": AMBER, "legacy": RED,
}  # fmt: skip
# Colour and marker of each group of policies: Okabe and Ito's colours, which colour-blind readers can
# distinguish, without the yellow. Then the styles of baselines, and of groups without their own style.
GROUP_STYLES = {
    "bytestream": ("#0072b2", "o"), "bytestream_xy": ("#56b4e9", "s"), "event_columns": ("#009e73", "^"),
    "event_set": ("#000000", "D"), "event_image": ("#d55e00", "v"), "event_image_vae": ("#e69f00", "P"),
    "rgb": ("#cc79a7", "X"), "bytestream_1500k": ("#7a5195", "<"), "bytestream_paper": ("#5b6b1f", "h"),
    "bytestream_robust": ("#b0003a", ">"), "bytestream_hold": ("#3a3ac8", "p"),
    "bytestream_late": ("#8f6bd6", "8"), "body_hold": ("#2f7f7f", "H"),
}  # fmt: skip
BASELINE_STYLES = {
    "oracle": ("#6b7280", "."),
    "straight": ("#9ca3af", "."),
    "random": ("#c4c9d1", "."),
}
OTHER_STYLES = (("#8c564b", "p"), ("#a6761d", "*"), ("#4b5563", "d"))
TAUGHT = "taught_"  # prefix of a kind's name in the groups of +exp=taught
