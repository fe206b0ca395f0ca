"""Film shipped policies for docs/watch.md, in small files.

Run from the repository root: python -m docs.draw_films [NAME ...]
Writes docs/films/NAME.mp4, 720 pixels wide, and docs/images/demo.gif for
the README. Every film shows the first corridor (seed 0), whatever happens in it; those in `FAILURES` show
the first corridor in which the policy fails. `corruptions` shows the corruptions of the benchmark
at severity 5: camera and events. Expect 7 minutes.
"""

import dataclasses
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from benchmarks.throughput import composed
from core.pictures import grey_picture
from jobs.analysis.colours import INK
from jobs.analysis.video import coloured, open_film, signs
from jobs.bench.protocol import read_protocol, tasks_of
from jobs.evaluation.demo import find_shown
from jobs.rollout.agents import PolicyAgent
from jobs.rollout.episodes import roll_out
from jobs.rollout.policies import read_policy
from jobs.rollout.recorded import Moment, record_episode
from models.policy import PRETRAINED, load_policy

DOCS = Path(__file__).resolve().parent
BODY = ("demo.policy=body_hold-s0",)
FILMS = {  # name: the words of the demo
    "poles": (),
    "textures": ("env.scene=texture_change", "fidelity.tolerance=0.2"),
    "moving": ("env.scene=dynamic", "fidelity.tolerance=0.2"),
    "dense": ("env.scene=poles_dense",),
    "false_events": ("faults.background_activity=0.25",),
    "dead_pixels": ("faults.sparsity=0.5",),
    "body": BODY,
    "balls": (
        *BODY,
        "+env.layout.num_obstacles=0",
        "+env.layout.throw_every_s=1.5",
        "+env.layout.throw_min_mps=10.0",
    ),
    "crash": ("demo.policy=bytestream-s1", "env.scene=texture_change", "fidelity.tolerance=0.2"),
}
FAILURES = {
    "fails_dense_25hz": ("env.scene=poles_dense", "env.control_hz=25"),
    "fails_late": ("env.action_delay_ms=100",),
}
CORRUPTIONS, SEVERITY, SHOWN_S, SHOWN_FPS = "corruptions", 5, 0.8, 10.0
ACROSS, SIDE, LINE, GAP = 3, 128, 20, 8  # corruptions in a row; pixels of a panel, a name and a gap
AT_ONCE, CORRIDORS = 20, 100  # corridors in which a failure is searched
# 10 frames a second at the speed of the demo, whatever its own rate; the last frame stays.
SMALL = ("-vf", "tpad=stop_mode=clone:stop_duration=0.3,fps=10,scale=720:-2", "-crf", "33", "-an")
MOVING = (
    "select=not(mod(n\\,6)),setpts=N*0.12/TB,scale=600:-2,split[a][b];[a]palettegen=max_colors=40:stats_mode=diff[p];"
    "[b][p]paletteuse=dither=none:diff_mode=rectangle"
)


def main() -> None:
    """Create the films that the command line names, or all."""
    (DOCS / "films").mkdir(exist_ok=True)
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    for name in sys.argv[1:] or (*FILMS, *FAILURES, CORRUPTIONS):
        if name == CORRUPTIONS:
            draw_corruptions()
            continue
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
    """Return the seed of the first held-out corridor in which the demo with these words fails.

    Raises:
        LookupError: The policy fails in none of the first `CORRIDORS`.
    """
    _, env, agent = find_shown(composed("+exp=demo", *words))
    for first in range(0, CORRIDORS, AT_ONCE):
        episodes = roll_out(agent, env, range(first, first + AT_ONCE), num_envs=AT_ONCE)
        failed = episodes["seed"][~episodes["success"]]
        if failed.size:
            return int(np.min(failed))
    raise LookupError(f"no failure in the first {CORRIDORS} corridors with {' '.join(words)}")


def draw_corruptions() -> None:
    """Film the start of one policy's flight in the first corridor, under each corruption of the sensor."""
    policy = read_policy(str(PRETRAINED / "bytestream_hold-s0"))
    found = {
        name: group[0].env
        for (name, severity), group in tasks_of(read_protocol(), "C", policy, "stochastic").items()
        if severity == SEVERITY
    }
    moments = {
        name: record_episode(
            PolicyAgent(load_policy(policy.agent), True), dataclasses.replace(env, time_limit_s=SHOWN_S), 0
        ).moments
        for name, env in found.items()
    }
    with tempfile.TemporaryDirectory() as place:
        whole = Path(place, "whole.mp4")
        with open_film(whole, 200.0, None, SHOWN_FPS) as film:
            for step in range(max(map(len, moments.values()))):
                film.add(side_by_side({name: own[min(step, len(own) - 1)] for name, own in moments.items()}))
        small = (imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", "-i", str(whole), "-crf", "34", "-an")
        subprocess.run([*small, str(DOCS / "films" / f"{CORRUPTIONS}.mp4")], check=True)
    last = side_by_side({name: own[len(own) // 2] for name, own in moments.items()})
    Image.fromarray(last).save(DOCS / "_static" / f"{CORRUPTIONS}.jpg", quality=80)


def side_by_side(moments: Mapping[str, Moment]) -> np.ndarray:
    """Return pictures of camera and events under the names of their corruptions, uint8 (H, W, 3)."""
    down = -(-len(moments) // ACROSS)
    size = (ACROSS * (2 * SIDE + GAP) + GAP, down * (SIDE + LINE + GAP) + GAP)
    picture, font = Image.new("RGB", size, INK), ImageFont.load_default(15)
    for place, (name, moment) in enumerate(moments.items()):
        row, column = divmod(place, ACROSS)
        left, top = GAP + column * (2 * SIDE + GAP), GAP + row * (SIDE + LINE + GAP)
        ImageDraw.Draw(picture).text((left, top), name.replace("_", " "), "white", font)
        camera = np.repeat(grey_picture(moment.luminance)[:, :, None], 3, axis=2)
        for k, panel in enumerate((camera, coloured(signs(moment.events)))):
            enlarged = Image.fromarray(panel).resize((SIDE, SIDE), Image.Resampling.NEAREST)
            picture.paste(enlarged, (left + k * SIDE, top + LINE))
    return np.asarray(picture)


if __name__ == "__main__":
    main()
