"""The contents of the site: groups of the sidebar and their pages.

Pages that do not exist are left out, because some are written by commands.
"""

from pathlib import Path

CONTENTS = {
    "Start": ("start", "watch", "models", "limits"),
    "Learn": ("task", "worlds", "events", "camera", "encoder", "statistics", "glossary"),
    "Do": (
        "experiments", "train", "sweep", "benchmark", "use", "own_camera", "recordings", "calibrate",
        "extend", "hyperparameters", "deploy", "dashboard", "troubleshooting",
    ),
    "Results": ("results", "claims", "studies", "data"),
    "Engineering": ("simulator", "trade", "numerics", "performance", "reliability"),
    "Reference": ("environment", "vehicles", "keys", "api", "code"),
    "Project": ("differences", "security", "citation"),
}  # fmt: skip
PLANS = sorted((Path(__file__).parent / "plans").glob("*.md"))
# Page of the sidebar -> the pages below it.
BELOW = {
    "studies": (
        "dose_response_taught", "ppo_paper", "ppo_event_set", "encoder_seeds", "camera_rates", "ablation",
        "training_lengths", "representations", "pooling",
        "plans/index",
    ),
    "plans/index": tuple(f"plans/{page.stem}" for page in PLANS if page.stem != "index"),
    "events": ("notebooks/events",),
    "encoder": ("notebooks/encoder",),
    "train": ("notebooks/policy",),
    "api": ("modules",),
}  # fmt: skip


def toctree(pages: tuple[str, ...], caption: str = "") -> str:
    """Return the directive that puts pages into the sidebar without showing a list of them."""
    head = [":hidden:", *([f":caption: {caption}"] if caption else [])]
    return "\n".join(["```{toctree}", *head, "", *(f"/{page}" for page in pages), "```", ""])
