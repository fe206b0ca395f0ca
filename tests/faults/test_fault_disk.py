"""Faults of the disk: full in each stage, slow, a kill at each rename."""

import functools
import json
import os
import re
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import jobs.evaluation.evaluate
import jobs.study.study
import jobs.training.pretrain  # noqa: F401  so that forks have it
from envs.recordings import WRITERS, Recording, read_recording, write_events, write_recording
from jobs.analysis.tables import save_plot
from jobs.analysis.video import open_film
from jobs.config.config import parse
from jobs.rollout.episodes import EPISODE
from jobs.rollout.policies import read_policy
from jobs.rollout.store import EpisodeStore, PartResult, SimulationAccuracy
from jobs.run import provenance
from jobs.run.checkpoints import seal
from jobs.run.files import RunError, json_lines, read_json_lines, write_atomic
from jobs.run.folder import Run, finish, finished, open_run, reopen
from jobs.tracking.tracker import TrackingError, open_store, open_tracker
from jobs.training.collect import data_file
from jobs.training.policy import pretrained_encoder
from jobs.training.pretrain import check_data
from models.policy import load_policy
from tests.support.configs import compose, small_config, sweep_config
from tests.support.encoders import make_events
from tests.support.faults import ROOT, forked, leave_room, outcome
from tests.support.policies import save_training
from tests.support.runs import planned, write_encoder
from tests.support.started import started

pytestmark = pytest.mark.faults
SHORT = ("budget=smoke", "env.time_limit_s=0.1")
EVALUATE = (
    "+exp=event_columns",
    "job=evaluate",
    *SHORT,
    "env.scene=poles_eval",
    "evaluate.episodes=1",
    "evaluate.renderers=[raycast]",
)
SWEEP = (
    "+exp=robustness",
    *SHORT,
    "~study.axes",
    "+study.axes.sparsity={faults.sparsity:[0.0,0.5]}",
    "study.policies=[newest,straight]",
    "study.reference=straight",
    "study.trials=1",
    "model=event_columns",
)
WORDS = {"evaluate": EVALUATE, "sweep": SWEEP}
STOPPED = (
    r"evade: failed: (.*): (?:No space left on device|a film .*); make room there, and .* same command.*"
)
OWN = ("tracking.json", "config.json", "config.yaml", ".lock")  # hold ids and paths


def prepare(folder: Path) -> None:
    """A policy to evaluate."""
    config = parse({**compose(*EVALUATE), "runs_dir": str(folder / "runs")})
    save_training(folder / "runs" / "trained" / "policy", "event_columns", 0, config.env)


def run_job(folder: Path, job: str, *words: str, fault: Callable[[], None] = lambda: None) -> tuple[int, str]:
    """Status and output of a job; its files name no commit, so that a change of the clone changes none."""

    def first() -> None:
        provenance._git = lambda *words: None
        fault()

    return forked(folder, *WORDS[job], *words, first=first)


def results(folder: Path) -> dict[str, bytes]:
    """What a job has left in its run folders, without the times at which metrics were logged."""
    files = (path for path in (folder / "runs").rglob("*") if path.is_file() and path.name not in OWN)
    logged = re.compile(rb'"(?:time_ms|checksum)": [^,}]*')  # the latter is of a line with its time
    return {
        str(path.relative_to(folder)): logged.sub(b"", path.read_bytes())
        if path.name.startswith("metrics-")
        else path.read_bytes()
        for path in files
    }


def whole(folder: Path) -> None:
    """Nothing half-written lies about."""
    assert not list(folder.rglob("*.part"))
    for path in folder.rglob("*.json"):
        json.loads(path.read_text())


def points(store: Path) -> dict[str, set[tuple[str, int, float]]]:
    """Run -> name, step and value of all that was logged."""
    client, experiment = open_store(f"sqlite:///{store}", "evade")
    return {
        run.info.run_name: {
            (name, point.step, point.value)
            for name in run.data.metrics
            for point in client.get_metric_history(run.info.run_id, name)
        }
        for run in client.search_runs([experiment])
        if run.info.status == "FINISHED"
    }


@pytest.fixture(scope="module")
def calm(tmp_path_factory):
    """Folders of each job without a fault, made when the first test wants them."""

    @functools.cache
    def run(job: str) -> Path:
        folder = tmp_path_factory.mktemp(job)
        prepare(folder)
        status, said = run_job(folder, job)
        assert status == 0, said
        return folder

    return run


def same(folder: Path, other: Path, store: Path) -> None:
    """The results of two folders are the same bytes, and so are the metrics in the stores."""
    found, wanted = results(folder), results(other)
    assert found.keys() == wanted.keys()
    assert [name for name in wanted if found[name] != wanted[name]] == []
    assert points(store) == points(other / "mlflow.db")


@pytest.mark.parametrize("job", WORDS)
def test_a_full_disk_stops_each_stage_and_with_room_the_same_command_gives_the_same(
    job, tmp_path, small_disk, calm
):
    prepare(small_disk)
    store = f"tracking.uri=sqlite:///{tmp_path}/mlflow.db"
    room, kept, status, stops = 1 << 13, {}, 1, set()
    while status:
        filler = leave_room(small_disk, room)
        status, said = run_job(small_disk, job, store)
        filler.unlink()
        whole(small_disk)
        if status:
            assert status == 1, said
            assert "Traceback" not in said
            found = re.fullmatch(STOPPED, said.splitlines()[-1])
            assert found, said
            stops.add(found[1])
        room, kept = room * (1 if results(small_disk).keys() - kept else 4), results(small_disk).keys()
    same(small_disk, calm(job), tmp_path / "mlflow.db")
    assert len(stops) >= 3
    outcome(f"disk full, {job}", "stops with the file and the remedy; continues to the same", "nothing")


def killing(notes: Path):
    """Kill the process where it gives a file a new name, once at each name."""
    rename = os.replace

    def replace(source, target, **named):
        known = notes.read_text().splitlines() if notes.exists() else []
        if str(target) not in known and not re.search("__pycache__|mlartifacts", str(target)):
            notes.write_text("\n".join([*known, str(target)]))
            os.kill(os.getpid(), signal.SIGKILL)
        rename(source, target, **named)

    os.replace = replace


def test_a_kill_at_each_rename_leaves_what_the_same_command_continues_to_the_same(tmp_path, calm):
    prepare(tmp_path)
    notes, status = tmp_path / "killed", -signal.SIGKILL
    while status == -signal.SIGKILL:
        status, said = run_job(tmp_path, "sweep", fault=functools.partial(killing, notes))
    assert status == 0, said
    assert len(notes.read_text().splitlines()) >= 8
    for part in tmp_path.rglob("*.part"):
        part.unlink()
    same(tmp_path, calm("sweep"), tmp_path / "mlflow.db")
    outcome("killed at each rename, sweep", "the same command continues to the same", "the file under way")


def slow():
    """Let whatever is stored, opened for writing or renamed take a tenth of a second."""
    for name in ("fsync", "replace", "rename", "link", "mkdir"):
        real = getattr(os, name)

        def late(*given, real=real, **named):
            time.sleep(0.1)
            return real(*given, **named)

        setattr(os, name, late)


def test_a_slow_disk_changes_no_result(tmp_path, calm):
    prepare(tmp_path)
    status, said = run_job(tmp_path, "sweep", fault=slow)
    assert status == 0, said
    same(tmp_path, calm("sweep"), tmp_path / "mlflow.db")
    outcome("slow disk, sweep", "the same results", "nothing")


def a_run(folder: Path) -> Run:
    return open_run(small_config(folder))


def of_run(name: str, write, read):
    """A kept file of a run folder, what writes it, and what the jobs read it by."""

    def make(folder: Path):
        run = a_run(folder)
        write(run)
        return run.path / name, lambda: read(run)

    return make


def read_data(run: Run):
    check_data(run)
    return {
        split: read_recording(data_file(run, split)).events.tobytes() for split in ("train", "validation")
    }


def write_data(run: Run):
    steps = {name: np.arange(2, dtype=np.int64) for name in ("step_t_us", "step_end_us", "step_flight")}
    for split in ("train", "validation"):
        write_recording(data_file(run, split), Recording(make_events(500), steps, {"seed": 1}))
    seal(run.data)


def read_encoder(run: Run):
    _, about = pretrained_encoder(run.config, run.encoder / "encoder.safetensors")
    return about


def read_agent(run: Run):
    load_policy(run.policy)
    return read_policy(str(run.policy))


def write_rows(file: Path) -> None:
    rows = [{"env_steps": 64 * number, "train/entropy": 0.5} for number in range(1, 9)]
    write_atomic(file, json_lines(rows))


def keep_encoder(run: Run):
    write_encoder(run.encoder, run.config)


def keep_policy(run: Run):
    save_training(run.policy, "a", 0, run.config.env)


def keep_stage(run: Run):
    finish(run, "train", {"eval/a": 0.25})


KEPT = {
    "recordings": of_run("data/train.h5", write_data, read_data),
    "encoder": of_run("encoder/encoder.safetensors", keep_encoder, read_encoder),
    "encoder's manifest": of_run("encoder/encoder.json", keep_encoder, read_encoder),
    "policy": of_run("policy/networks.safetensors", keep_policy, read_agent),
    "policy's manifest": of_run("policy/policy.json", keep_policy, read_agent),
    "finished stage": of_run("stages/train.json", keep_stage, lambda run: finished(run, "train")),
    "configuration": of_run("config.json", lambda run: None, lambda run: reopen(run.path, run.config).config),
}


def cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def flips(content: bytes):
    """The content with one bit changed, at nine places."""
    for place in np.linspace(0, len(content) - 1, 9).astype(int):
        changed = bytearray(content)
        changed[place] ^= 1
        yield bytes(changed)


def refusal(read) -> tuple[object, Exception | None]:
    """What is read, or why it is not."""
    try:
        return read(), None
    except (RunError, ValueError) as error:
        return None, error


@pytest.mark.parametrize("name", KEPT)
def test_a_kept_file_that_is_damaged_is_refused_by_name_with_a_remedy(name, tmp_path):
    file, read = KEPT[name](tmp_path)
    content, wanted = file.read_bytes(), read()
    for damaged in (cut(content), b"", *flips(content)):
        file.write_bytes(damaged)
        found, error = refusal(read)
        if error is None:
            assert len(damaged) == len(content)
            assert found == wanted
        else:
            assert type(error).__module__.split(".")[0] in ("jobs", "models")
            assert str(file.parent) in str(error)
            assert re.search("delete|copy|again", str(error)), error
    outcome(f"damaged: {name}", "refused with the file and the remedy", "nothing else")


def test_a_damaged_line_of_results_is_named_and_a_cut_one_is_dropped(tmp_path):
    file = tmp_path / "results.jsonl"
    write_rows(file)
    content, wanted = file.read_bytes(), read_json_lines(file)
    for damaged in (cut(content), b"", *flips(content)):
        file.write_bytes(damaged)
        found, error = refusal(lambda: read_json_lines(file))
        if error is None:
            assert found == wanted[: len(found)]
        else:
            assert f"{file}: line" in str(error)
            assert len(damaged) == len(content)
    outcome("damaged: results, retry queue", "the line is refused; half a line is dropped", "that line")


def test_a_damaged_file_of_episodes_or_accuracy_is_put_aside(tmp_path, capsys):
    task, store = planned(sweep_config(tmp_path), "straight").tasks[0], EpisodeStore(tmp_path / "sweep")
    episodes = np.zeros(len(task.seeds), EPISODE)
    episodes["seed"] = task.seeds
    for kind in ("episodes", "accuracy"):
        store.add(task, PartResult(episodes, {}, SimulationAccuracy(0.125, 5.0)), "c0")
        (file,) = (store.folder / kind).glob("*.json")
        content = file.read_bytes()
        for damaged in (cut(content), b"", *flips(content)):
            file.write_bytes(damaged)
            read = store.missing(task).seeds == () if kind == "episodes" else store.accuracy(task) is not None
            if read:
                assert store.result(task).episodes.tolist() == episodes.tolist()
                assert store.accuracy(task) == SimulationAccuracy(0.125, 5.0)
            else:
                assert f"put aside, evaluated again: {file}" in capsys.readouterr().out
                assert file.with_suffix(".damaged").read_bytes() == damaged
    outcome("damaged: stored episodes, accuracy", "reported and put aside; made again", "that task")


def test_a_damaged_store_is_refused_with_its_remedy(tmp_path):
    run = a_run(tmp_path)
    file = tmp_path / "mlflow.db"
    with open_tracker(run.config, run):
        pass
    content = file.read_bytes()
    for damaged in (cut(content), bytes([content[0] ^ 1]) + content[1:], content[:5000]):
        file.write_bytes(damaged)
        with (
            pytest.raises(TrackingError, match=rf"{file}: damaged \(.*move it away"),
            open_tracker(run.config, run),
        ):
            pass
    outcome("damaged: mlflow.db", "refused with the file and the remedy", "nothing of the run folder")


def write_film(file: Path) -> None:
    with open_film(file, 50.0, None) as film:
        for step in range(3):
            film.step(np.full((64, 64), step, np.float32), None, np.zeros((1, 4), np.int32), "caption")


def write_format(format: str, file: Path) -> None:
    write_events(file, make_events(20_000), 16, 12, format)


def write_picture(file: Path) -> None:
    figure = Figure()
    figure.add_subplot().plot([0.0, 1.0])
    save_plot(file, figure)


WRITERS_OF_FILES = {
    **{format: functools.partial(write_format, format) for format in WRITERS},
    "film": write_film,
    "plot": write_picture,
    "results": write_rows,
}


@pytest.mark.parametrize("name", WRITERS_OF_FILES)
def test_a_file_that_finds_the_disk_full_is_named_and_leaves_the_old_one(name, small_disk):
    write, file = WRITERS_OF_FILES[name], small_disk / "kept"
    write(file)
    content = file.read_bytes()
    for room in (0, len(content) // 2 // 4096 * 4096):
        filler = leave_room(small_disk, room)
        with pytest.raises((OSError, RunError), match=f"{small_disk}.*|No space") as error:
            write(file)
        filler.unlink()
        assert str(small_disk) in str(error.value)
        assert file.read_bytes() == content
        assert [path.name for path in small_disk.iterdir()] == ["kept"]
    write(file)
    assert file.read_bytes() == content
    outcome(f"disk full: {name}", "the file is named; the old one stays", "nothing")


KERNEL = "import numba\n\n@numba.njit(cache=True)\ndef inner(x):\n    return x + 1.0\n"


def test_compiled_kernels_that_are_cut_are_compiled_again(tmp_path):
    package = tmp_path / "envs"  # models prepares its kernels alike
    package.mkdir()
    shutil.copy(ROOT / "envs" / "__init__.py", package)
    shutil.copytree(ROOT / "core", tmp_path / "core")
    (package / "kernel.py").write_text(KERNEL)
    words = (sys.executable, "-c", "from envs.kernel import inner; print(inner(1.0))")

    assert started(*words, cwd=tmp_path).stdout == "2.0\n"
    for pattern in ("*.nbi", "*.nbc"):
        (file,) = package.rglob(pattern)
        content = file.read_bytes()
        for damaged in (b"", cut(content)):
            file.write_bytes(damaged)
            assert started(*words, cwd=tmp_path).stdout == "2.0\n"
            assert len(file.read_bytes()) == len(content)
    outcome("damaged: compiled kernels", "compiled again", "a minute")
