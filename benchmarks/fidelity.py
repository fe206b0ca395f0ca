"""Measure the event error by number of renders and samples, on which `envs.fidelity.plan_renders` is based.

Run: python -m benchmarks.fidelity [scene ...]
Expect: about two minutes per scene on one core; by default poles and texture_change. For each
control rate and threshold: the event error at 1 to 16 renders per control step with converged
anti-aliasing, then at 1 to 4 samples with converged renders, then with the plan for tolerance
0.05.
"""

import dataclasses
import sys

from envs.config import CameraConfig, EnvConfig, FidelityConfig
from envs.event_error import REFERENCE_SAMPLES, measure_event_error
from jobs.analysis.tables import show_table

RATES_HZ = (45.0, 100.0, 200.0, 400.0)
THRESHOLDS = (0.05, 0.2, 0.5)
RENDERS = (1, 2, 3, 4, 6, 8, 12, 16)
SAMPLES = (1, 2, 3, 4)
EPISODES, STEPS = 6, 12


def main() -> None:
    """Measure and print one table per scene."""
    head = [
        *("Hz", "threshold"),
        *(f"{count} renders" for count in RENDERS),
        *(f"{count} samples" for count in SAMPLES),
        *("plan", "its renders"),
    ]
    for scene in sys.argv[1:] or ("poles", "texture_change"):
        rows = [
            (f"{hz:g}", f"{threshold:g}", *errors(scene, hz, threshold))
            for hz in RATES_HZ
            for threshold in THRESHOLDS
        ]
        show_table(f"Event error [%] in {scene}", head, rows, 0)


def errors(scene: str, hz: float, threshold: float) -> list[str]:
    """Return the cells of one row."""
    config = EnvConfig(scene=scene, control_hz=hz, camera=CameraConfig(contrast_threshold=threshold))
    step_m = config.speed_mps / hz
    exact = REFERENCE_SAMPLES["raycast"]
    tried = [FidelityConfig(max_step_m=step_m / renders, samples=exact) for renders in RENDERS]
    tried += [FidelityConfig(max_step_m=step_m / 32, samples=samples) for samples in SAMPLES]
    tried += [FidelityConfig()]
    measured = [
        measure_event_error(dataclasses.replace(config, fidelity=fidelity), EPISODES, STEPS)
        for fidelity in tried
    ]
    return [f"{100 * accuracy.error:.1f}" for accuracy in measured] + [f"{measured[-1].renders:.1f}"]


if __name__ == "__main__":
    main()
