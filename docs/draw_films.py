"""Roll out shipped policies for docs/watch.md, and keep the films small.

Run from the repository root: python -m docs.draw_films [NAME ...]
Writes docs/films/NAME.mp4, 720 pixels wide, and docs/images/demo.gif for
the README. Every film is one corridor, the first (seed 0), whatever happens in it; those of `FAILURES`
the first in which the policy fails. Expect 6 minutes.
"""

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from benchmarks.throughput import composed
from jobs.evaluation.demo import find_shown
from jobs.rollout.episodes import roll_out

DOCS = Path(__file__).resolve().parent
FILMS = {  # name: the words of the demo
    "poles": (),
    "textures": ("env.scene=texture_change", "fidelity.tolerance=0.2"),
    "moving": ("env.scene=dynamic", "fidelity.tolerance=0.2"),
    "dense": ("env.scene=poles_dense",),
    "false_events": ("faults.background_activity=0.25",),
    "dead_pixels": ("faults.sparsity=0.5",),
    "crash": ("demo.policy=bytestream-s1", "env.scene=texture_change", "fidelity.tolerance=0.2"),
}
FAILURES = {
    "fails_dense_25hz": ("env.scene=poles_dense", "env.control_hz=25"),
    "fails_dense": ("env.scene=poles_dense",),
    "fails_late": ("env.action_delay_ms=100",),
}
AT_ONCE, CORRIDORS = 20, 100  # in which a failure is looked for
# 10 frames a second at the speed of the demo, whatever its own rate; the last frame stays.
SMALL = ("-vf", "tpad=stop_mode=clone:stop_duration=0.3,fps=10,scale=720:-2", "-crf", "33", "-an")
MOVING = (
    "select=not(mod(n\\,6)),setpts=N*0.12/TB,scale=600:-2,split[a][b];[a]palettegen=max_colors=40:stats_mode=diff[p];"
    "[b][p]paletteuse=dither=none:diff_mode=rectangle"
)


def main() -> None:
    """Make the films that the command line names, or all."""
    (DOCS / "films").mkdir(exist_ok=True)
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    for name in sys.argv[1:] or (*FILMS, *FAILURES):
        with tempfile.TemporaryDirectory() as place:
            words = [f"runs_dir={place}", *(FILMS | FAILURES)[name]]
            if name in FAILURES:
                words.append(f"seed={first_failure(FAILURES[name])}")
            subprocess.run([sys.executable, "-m", "platform.launch", "+exp=demo", *words], check=True)
            (film,) = Path(place).glob("*/demo/*.mp4")
            small = [ffmpeg, "-v", "error", "-y", "-i", str(film)]
            subprocess.run([*small, *SMALL, str(DOCS / "films" / f"{name}.mp4")], check=True)
            still = ("-frames:v", "1", "-q:v", "5", str(DOCS / "_static" / f"{name}.jpg"))
            cut = [ffmpeg, "-v", "error", "-y", "-ss", "1", "-i", str(DOCS / "films" / f"{name}.mp4")]
            subprocess.run([*cut, *still], check=True)
            if name == "poles":
                subprocess.run(
                    [*small, "-vf", MOVING, "-r", "25/3", str(DOCS / "images" / "demo.gif")], check=True
                )


def first_failure(words: Sequence[str]) -> int:
    """The first held-out corridor in which a demo of these words shows a failure.

    Raises:
        LookupError: There is none among the first `CORRIDORS`.
    """
    _, env, agent = find_shown(composed("+exp=demo", *words))
    for first in range(0, CORRIDORS, AT_ONCE):
        episodes = roll_out(agent, env, range(first, first + AT_ONCE), num_envs=AT_ONCE)
        failed = episodes["seed"][~episodes["success"]]
        if failed.size:
            return int(np.min(failed))
    raise LookupError(f"no failure in the first {CORRIDORS} corridors with {' '.join(words)}")


if __name__ == "__main__":
    main()
