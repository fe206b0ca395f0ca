"""Roll out shipped policies for docs/gallery.md, and keep the films small.

Run from the repository root: python -m docs.draw_films [NAME ...]
Writes docs/films/NAME.mp4, 720 pixels wide, and docs/images/demo.gif for
the README. Every film is one corridor, the first (seed 0), whatever happens in it. Expect 3 minutes.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import imageio_ffmpeg

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
# Of the frames of a demo, 50 a second, keep each fifth and show 10 a second: the same speed.
SMALL = ("-vf", "select=not(mod(n\\,5)),setpts=N/10/TB,scale=720:-2", "-r", "10", "-crf", "33", "-an")
MOVING = (
    "select=not(mod(n\\,6)),setpts=N*0.12/TB,scale=600:-2,split[a][b];[a]palettegen=max_colors=40:stats_mode=diff[p];"
    "[b][p]paletteuse=dither=none:diff_mode=rectangle"
)


def main() -> None:
    """Make the films that the command line names, or all."""
    (DOCS / "films").mkdir(exist_ok=True)
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    for name in sys.argv[1:] or FILMS:
        with tempfile.TemporaryDirectory() as place:
            words = [f"runs_dir={place}", *FILMS[name]]
            subprocess.run([sys.executable, "-m", "platform.launch", "+exp=demo", *words], check=True)
            (film,) = Path(place).glob("*/demo/*.mp4")
            small = [ffmpeg, "-v", "error", "-y", "-i", str(film)]
            subprocess.run([*small, *SMALL, str(DOCS / "films" / f"{name}.mp4")], check=True)
            if name == "poles":
                subprocess.run(
                    [*small, "-vf", MOVING, "-r", "25/3", str(DOCS / "images" / "demo.gif")], check=True
                )


if __name__ == "__main__":
    main()
