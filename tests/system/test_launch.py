import errno
import os
import re
import shlex
import signal
import sys
from pathlib import Path

import pytest

from jobs.config.command_line import experiments
from jobs.config.config import Config, parse
from jobs.run import libraries
from jobs.run.libraries import held
from tests.support.configs import compose
from tests.support.started import ROOT, said, started

EVADE = Path(sys.executable).parent / "evade"
HEAVY = ("torch", "ray", "mlflow", "numba", "matplotlib", "gymnasium", "trimesh", "pyrender", "h5py", "scipy")


@pytest.mark.system
@pytest.mark.parametrize("words", [["--help"], ["+exp=bytestream", "algo.lr=nan"]])
def test_answers_come_without_anything_heavy_and_alike_from_the_command_in_any_folder(words, tmp_path):
    here = started(sys.executable, "-X", "importtime", "-m", "platform.launch", *words)
    timed, told = [], []
    for line in here.stderr.splitlines():
        (timed if line.startswith("import time:") else told).append(line)
    imported = {line.rpartition("|")[2].strip() for line in timed}
    assert "hydra" in imported
    assert imported.isdisjoint(HEAVY)
    assert len(imported) < 650
    there = started(EVADE, *words, cwd=tmp_path)
    assert (here.returncode, here.stdout, told) == (there.returncode, there.stdout, there.stderr.splitlines())
    if "algo.lr=nan" in words:
        assert told == ["evade: refused: algo.lr: Input should be a finite number, got nan"]
        assert (here.returncode, here.stdout) == (2, "")
    assert list(tmp_path.iterdir()) == []


def test_a_job_begins_before_anything_heavy_is_imported_and_a_terminal_of_ascii_shows_question_marks():
    code = """
import sys, types, jobs
from jobs.config.registry import JOBS
from jobs.run.progress import console
sys.modules["stub"] = types.SimpleNamespace(run=lambda config: (console.print("a · b"), print(*sys.modules)))
JOBS["train"] = JOBS["train"]._replace(module="stub")
sys.argv = ["evade", "+exp=train"]
sys.exit(jobs.main())
"""
    ran = started(sys.executable, "-c", code, PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert ran.returncode == 0, ran.stderr
    begun, marked, imported = ran.stdout.splitlines()
    assert begun.startswith("If this is stopped")
    assert marked == "a ? b"
    assert set(imported.split()).isdisjoint(HEAVY)


def test_help_names_every_job_experiment_and_budget(launch, launcher):
    status, out, err = launch("--help")
    assert (status, err) == (0, "")
    for group in ("exp", "budget"):
        for file in (ROOT / "conf" / group).glob("*.yaml"):
            assert f"\n  {file.stem} " in out
    for name, job in launcher.JOBS.items():
        assert f"\n  {name:<16} {job.summary}\n" in out
    assert out.count("\n  evade +exp=") == 7
    assert "$" not in out


def test_cfg_job_prints_the_composed_configuration(launch):
    status, out, err = launch("--cfg", "job", "+exp=bytestream", "budget=smoke", "seed=3")
    assert (status, err) == (0, "")
    assert "\nseed: 3\n" in out
    assert "\nbudget: smoke\n" in out


@pytest.mark.system
def test_a_python_without_the_packages_is_told_the_environment_in_one_line():
    told = said(sys.executable, "-S", "-m", "platform.launch", "+exp=demo", status=1)  # no site-packages
    assert re.fullmatch(r"evade: failed: .*`make setup`.*`source \.venv/bin/activate`.*\n", told)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["foo=1"], "foo: no such key, got foo=1; --cfg job shows every key"),
        (["sed=1"], "sed: no such key, got sed=1; did you mean seed?"),
        (["contrast_threshold=0.1"], "did you mean camera.contrast_threshold?"),
        (["env.control-hz=45"], "did you mean env.control_hz?"),
        (["env.control_hz=fast"], "env.control_hz: Input should be a valid number, got 'fast'"),
        (["env.split=eval"], "env.split: no such key, got env.split=eval; every job chooses it itself"),
        (["seed=null"], "seed: Input should be a valid integer, got None"),
        (["budget=huge"], "budget: must be one of paper, short, smoke, got 'huge'"),
        (["seed=[1"], "seed=[1: "),
        (["seed"], "Error parsing override 'seed'"),
        (["seed=1,2"], "'seed=1,2': write [a,b] for a list; one command is one run; give it once per value"),
        (
            ["--multirun", "seed=1,2"],
            "--multirun: one command is one run; give it once per value: for value in 1 2;",
        ),
        (["hydra.mode=MULTIRUN"], "hydra.mode=MULTIRUN: one command is one run"),
        (["trade.trials=3"], "trade.trials: no such key, got trade.trials=3; a setting of the job trade"),
        (
            ["tracking.uri=nowhere"],
            "tracking.uri: must begin with sqlite:/// or http:// or https://, got 'nowhere'",
        ),
        (["hydra.run.dir=elsewhere"], "hydra.run.dir=elsewhere: Hydra's own settings are fixed"),
        (["+hydra.callbacks.x._target_=os.system"], "Hydra's own settings are fixed"),
        (["+env.layout._target_=os.system"], "env.layout._target_: such keys make Hydra call code"),
        (["++algo={_target_:torch.load,f:x}"], "algo._target_: such keys make Hydra call code"),
        (["+study.axes.x=[{_target_:os.remove}]"], "study.axes.x.0._target_: such keys make Hydra call code"),
        (["tracking.uri=${oc.env:HOME}"], "tracking.uri: must be the value itself, not a reference"),
        (["--experimental-rerun=config.pickle"], "Hydra's own settings are fixed"),
    ],
)
def test_a_refused_command_line_ends_with_status_2_and_one_message(launch, job, tmp_path, words, message):
    job(lambda config: pytest.fail("the job must not start"))
    status, out, err = launch("+exp=train", *words)
    assert (status, out) == (2, "")
    assert message in err
    assert err.startswith("evade: refused: ")
    assert len(err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "name an experiment with +exp=NAME, one of ablation, "),
        (["budget=smoke"], "name an experiment with +exp=NAME, one of ablation, "),
        (["exp=train"], "use +exp=train"),
        (["+exp=trian"], "got 'trian'"),
    ],
)
def test_without_an_experiment_or_with_a_misspelt_one_the_message_says_so(launch, words, message):
    status, _, err = launch(*words)
    assert status == 2
    assert message in err
    assert len(err.splitlines()) == 1


def test_the_job_gets_the_checked_configuration_and_nothing_is_left_in_the_folder(
    launch, job, tmp_path, monkeypatch
):
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    given = []
    job(given.append)
    words = [
        "env.scene=poles_eval",
        "+env.layout.num_obstacles=60",
        "seed=3",
        "renderer=raycast",
        "runs_dir=elsewhere",
    ]
    status, out, err = launch("+exp=train", *words)
    assert (status, err) == (0, "")
    (line,) = out.splitlines()
    begun, _, command = line.partition(": ")
    assert begun == "If this is stopped, it continues with"
    assert shlex.split(command) == [sys.executable, "-m", "platform.launch", "+exp=train", *words]
    (config,) = given
    assert isinstance(config, Config)
    assert (config.job, config.seed, config.env.renderer, config.runs_dir) == (
        "train",
        3,
        "raycast",
        "elsewhere",
    )
    assert config.env.layout == {"num_obstacles": 60.0}
    assert list(tmp_path.iterdir()) == []
    assert "HYDRA_FULL_ERROR" not in os.environ


def test_a_process_gets_one_thread_unless_the_user_says_otherwise(launch, launcher, job, monkeypatch):
    settings = held({"avx2", "fma", "avx512vl"})
    for name in settings:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(libraries, "processor", lambda: {"flags": "avx2 fma avx512vl"})
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    seen = []
    job(lambda config: seen.append({name: os.environ[name] for name in settings}))
    assert launch("+exp=train")[0] == 0
    assert seen == [{**settings, "OMP_NUM_THREADS": "4"}]
    assert seen[0]["NPY_DISABLE_CPU_FEATURES"] == "X86_V4"


def unknown_scene(config):
    from envs.scene import make_scene

    make_scene("moon", None)


@pytest.mark.parametrize("value", ["1", "0"])
def test_a_value_that_the_job_refuses_is_one_message_and_its_traceback_if_hydra_full_error_is_1(
    launch, job, monkeypatch, value
):
    monkeypatch.setenv("HYDRA_FULL_ERROR", value)
    job(unknown_scene)
    status, _, err = launch("+exp=train")
    assert status == 2
    assert "moon" in err.splitlines()[-1]
    assert (len(err.splitlines()) > 1) == ("Traceback" in err) == (value == "1")
    assert os.environ["HYDRA_FULL_ERROR"] == value


def lost_renderer(config):
    raise KeyError("renderer")


def denied(config):
    raise PermissionError(errno.EACCES, "Permission denied", "/elsewhere/file")


@pytest.mark.parametrize(
    ("fails", "traced", "message"),
    [
        (lost_renderer, True, "KeyError: 'renderer'"),
        (denied, False, "/elsewhere/file: Permission denied; give yourself the right to use it, and the same "
         "command continues"),
    ],
)  # fmt: skip
def test_a_failure_ends_with_status_1_and_its_traceback_or_with_the_folder_and_what_to_do(
    launch, job, fails, traced, message
):
    job(fails)
    status, _, err = launch("+exp=train")
    assert status == 1
    assert err.endswith(f"evade: failed: {message}\n")
    assert (len(err.splitlines()) > 1) == ("Traceback" in err) == traced


@pytest.mark.parametrize(
    ("number", "status", "ended"),
    [
        (signal.SIGTERM, 143, "ended by SIGTERM"),
        (signal.SIGHUP, 129, "ended by SIGHUP"),
        (signal.SIGINT, 130, "interrupted"),
    ],
)
def test_a_signal_ends_with_its_status_and_one_line(launch, job, number, status, ended):
    # A background shell starts its children deaf to Ctrl+C; Python then makes no exception of it.
    before = signal.signal(number, signal.default_int_handler)
    job(lambda config: signal.raise_signal(number))
    try:
        found, _, err = launch("+exp=train")
    finally:
        signal.signal(number, before)
    assert (found, err) == (status, f"evade: {ended}; the same command continues where it stopped\n")


def test_the_remedy_for_several_seeds_runs_each_seed_once(launch, tmp_path):
    _, _, err = launch("-m", "+exp=event_columns", "seed=0,1", "budget=smoke")
    loop = err[err.index("for value in") :].strip()
    told = tmp_path / "evade"
    told.write_text('#!/bin/sh\necho "$@"\n')
    told.chmod(0o755)
    given = said("bash", "-c", loop, PATH=f"{tmp_path}:{os.environ['PATH']}").splitlines()
    assert given == [f"+exp=event_columns budget=smoke seed={seed}" for seed in (0, 1)]
    assert [parse(compose(*line.split())).seed for line in given] == [0, 1]


def test_a_refusal_by_the_job_leaves_nothing_in_the_folder(launch, job, tmp_path):
    def refuse(config):
        from jobs.run.folder import open_run

        assert open_run(config).path.is_dir()
        unknown_scene(config)

    job(refuse)
    assert launch("+exp=train")[0] == 2
    assert list(tmp_path.iterdir()) == []


def test_every_job_has_an_experiment_that_runs_it(launcher):
    files = {name: ROOT / "conf" / "exp" / f"{name}.yaml" for name in experiments()}
    texts = "\n".join(file.read_text() for file in files.values() if file.is_file())
    by_name = {name for name, file in files.items() if not file.is_file()}
    named = {"pipeline", *by_name, *re.findall(r"override /job: (\w+)", texts)}  # or else conf/config.yaml's
    assert named == set(launcher.JOBS)


def test_the_launcher_says_so_when_conf_is_not_there(launch, launcher, monkeypatch, tmp_path):
    monkeypatch.setattr(launcher, "CONF", tmp_path / "conf")
    status, _, err = launch("+exp=train")
    assert status == 2
    assert "pip install -e ." in err


@pytest.mark.system
def test_this_machine_gives_the_published_digits():
    ran = started(sys.executable, "-m", "platform.launch", "fingerprint")
    assert (ran.returncode, ran.stdout.split()[-1]) == (0, "equal"), ran.stdout + ran.stderr
