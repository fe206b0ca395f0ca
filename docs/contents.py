"""The contents of the site: the groups of the sidebar, and the pages of each.

A page that is not there is left out: commands write some of them.
"""

CONTENTS = {
    "Start": ("start", "watch", "models", "limits"),
    "Learn": ("task", "events", "camera", "encoder", "statistics", "glossary"),
    "Do": (
        "experiments", "train", "sweep", "use", "own_camera", "recordings", "calibrate", "extend",
        "hyperparameters", "deploy", "dashboard", "troubleshooting",
    ),
    "Results": ("results", "claims", "studies", "data"),
    "Engineering": ("simulator", "encoder_accuracy", "trade", "numerics", "performance", "reliability"),
    "Reference": ("environment", "vehicles", "keys", "api", "code"),
    "Project": ("differences", "alternatives", "contributing", "security", "citation"),
}  # fmt: skip
# A page of the sidebar -> pages below it, which it lists itself.
BELOW = {
    "studies": (
        "pooling", "dose_response_taught", "dose_response", "ppo_claims", "taught_claims", "ppo_paper",
        "ppo_event_set", "encoder_seeds", "camera_rates", "ablation", "training_lengths", "representations",
    ),
    "events": ("notebooks/events",),
    "encoder": ("notebooks/encoder",),
    "train": ("notebooks/policy",),
    "results": ("robustness",),
    "data": ("results_tables",),
    "api": ("modules",),
}  # fmt: skip


def toctree(pages: tuple[str, ...], caption: str = "") -> str:
    """Return the directive that puts pages into the sidebar without showing a list of them."""
    head = [":hidden:", *([f":caption: {caption}"] if caption else [])]
    return "\n".join(["```{toctree}", *head, "", *pages, "```", ""])
