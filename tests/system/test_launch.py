import errno
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jobs.config.command_line import experiments
from jobs.config.config import Config, parse
from jobs.run import libraries
from jobs.run.libraries import held
from tests.support.configs import compose

ROOT = Path(__file__).resolve().parents[2]
EVADE = Path(sys.executable).parent / "evade"
HEAVY = ("torch", "ray", "mlflow", "numba", "matplotlib", "gymnasium", "trimesh", "pyrender", "h5py", "scipy")


def shell(*command: str | Path, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.system
@pytest.mark.parametrize("words", [["--help"], ["--cfg", "job", "+exp=train"], ["+exp=train", "seed=-1"]])
def test_answers_come_without_importing_anything_heavy(words):
    result = shell(sys.executable, "-X", "importtime", "-m", "platform.launch", *words)
    imported = {line.rpartition("|")[2].strip() for line in result.stderr.splitlines() if "|" in line}
    assert "hydra" in imported
    assert imported.isdisjoint(HEAVY)
    assert len(imported) < 650


def test_a_job_begins_before_anything_heavy_is_imported():
    code = """
import sys, types, jobs
from jobs.config.registry import JOBS, Job
sys.modules["stub"] = types.SimpleNamespace(run=lambda config: print(*sys.modules))
JOBS["train"] = Job("stub")
sys.argv = ["evade", "+exp=train"]
sys.exit(jobs.main())
"""
    result = shell(sys.executable, "-c", code)
    assert result.returncode == 0
    said, imported = result.stdout.splitlines()
    assert said.startswith("If this is stopped")
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


def test_the_module_refuses_with_one_message_and_no_traceback(tmp_path):
    result = shell(sys.executable, "-m", "platform.launch", "+exp=bytestream", "algo.lr=nan")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == "evade: refused: algo.lr: Input should be a finite number, got nan\n"


@pytest.mark.system
@pytest.mark.skipif(not EVADE.exists(), reason="the command is not installed; run `pip install -e .`")
def test_a_python_without_the_packages_is_told_the_environment_in_one_line():
    command = [sys.executable, "-S", "-m", "platform.launch", "+exp=demo"]  # -S: without site-packages
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert re.fullmatch(r"evade: failed: .*`make setup`.*`source \.venv/bin/activate`.*\n", done.stderr)


def test_the_command_is_the_same_launcher_in_any_folder(tmp_path):
    words = ("+exp=bytestream", "seed=five")
    here, there = shell(sys.executable, "-m", "platform.launch", *words), shell(EVADE, *words, cwd=tmp_path)
    assert (here.returncode, here.stderr) == (there.returncode, there.stderr)
    assert here.returncode == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["foo=1"], "foo: no such key, got foo=1; --cfg job shows every key"),
        (["+foo=1"], "foo: no such key, got 1; --cfg job shows every key"),
        (["sed=1"], "sed: no such key, got sed=1; did you mean seed?"),
        (["contrast_threshold=0.1"], "did you mean camera.contrast_threshold?"),
        (["env.control-hz=45"], "did you mean env.control_hz?"),
        (["env.control_hz=fast"], "env.control_hz: Input should be a valid number, got 'fast'"),
        (["env.split=eval"], "env.split: no such key, got env.split=eval; every job chooses it itself"),
        (["seed=null"], "seed: Input should be a valid integer, got None"),
        (["seed="], "seed: Input should be a valid integer, got ''"),
        (["job=os.system"], "job: must be one of bench, "),
        (["budget=huge"], "budget: must be one of paper, short, smoke, got 'huge'"),
        (["env=3"], "env=3: "),
        (["seed=[1"], "seed=[1: "),
        (["seed"], "Error parsing override 'seed'"),
        (["seed=1,2"], "'seed=1,2': write [a,b] for a list; one command is one run; give it once per value"),
        (
            ["--multirun", "seed=1,2"],
            "--multirun: one command is one run; give it once per value: for value in 1 2;",
        ),
        (["-m"], "-m: one command is one run; give it once per value"),
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


@pytest.mark.parametrize("words", [[], ["budget=smoke"], ["seed=1"]])
def test_without_an_experiment_the_message_lists_them(launch, words):
    status, _, err = launch(*words)
    assert status == 2
    assert "name an experiment with +exp=NAME, one of ablation, " in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("word", "message"), [("exp=train", "use +exp=train"), ("+exp=trian", "got 'trian'")]
)
def test_a_misspelt_experiment_is_refused(launch, word, message):
    status, _, err = launch(word)
    assert status == 2
    assert message in err


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
    said, _, command = line.partition(": ")
    assert said == "If this is stopped, it continues with"
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


def lost_renderer(config):
    raise KeyError("renderer")


def test_a_value_that_the_job_refuses_ends_with_status_2_and_one_message(launch, job):
    job(unknown_scene)
    status, _, err = launch("+exp=train")
    assert status == 2
    assert "moon" in err
    assert len(err.splitlines()) == 1


def test_an_unexpected_failure_shows_its_traceback_and_ends_with_status_1(launch, job):
    job(lost_renderer)
    status, _, err = launch("+exp=train")
    assert status == 1
    assert "Traceback" in err
    assert err.endswith("evade: failed: KeyError: 'renderer'\n")


@pytest.mark.parametrize(("value", "shown"), [("1", True), ("0", False), ("", False)])
def test_the_traceback_of_a_wrong_value_is_shown_if_hydra_full_error_is_1(
    launch, job, monkeypatch, value, shown
):
    monkeypatch.setenv("HYDRA_FULL_ERROR", value)
    job(unknown_scene)
    status, _, err = launch("+exp=train")
    assert status == 2
    assert ("Traceback" in err) == shown
    assert os.environ["HYDRA_FULL_ERROR"] == value


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal_ends_with_its_status_and_one_line(launch, job, number, status):
    before = signal.getsignal(number)
    job(lambda config: signal.raise_signal(number))
    try:
        ended, _, err = launch("+exp=train")
    finally:
        signal.signal(number, before)
    assert ended == status
    assert err == f"evade: ended by {number.name}; the same command continues where it stopped\n"


def test_the_remedy_for_several_seeds_runs_each_seed_once(launch, tmp_path):
    _, _, err = launch("-m", "+exp=event_columns", "seed=0,1", "budget=smoke")
    loop = err[err.index("for value in") :].strip()
    told = tmp_path / "evade"
    told.write_text('#!/bin/sh\necho "$@"\n')
    told.chmod(0o755)
    path = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    said = subprocess.run(["bash", "-c", loop], env=path, capture_output=True, text=True, check=True).stdout
    assert said.splitlines() == [f"+exp=event_columns budget=smoke seed={seed}" for seed in (0, 1)]
    assert [parse(compose(*line.split())).seed for line in said.splitlines()] == [0, 1]


def test_a_terminal_that_takes_ascii_alone_shows_question_marks(tmp_path):
    code = "import sys, types, jobs\nfrom jobs.config.registry import JOBS, Job\n"
    code += "from jobs.run.progress import console\n"
    code += "sys.modules['stub'] = types.SimpleNamespace(run=lambda config: console.print('a · b'))\n"
    code += "JOBS['train'] = Job('stub'); sys.argv = ['evade', '+exp=train']; sys.exit(jobs.main())"
    settings = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=settings, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, b"a ? b")


def test_a_refusal_by_the_job_leaves_nothing_in_the_folder(launch, job, tmp_path):
    def refuse(config):
        from jobs.run.folder import open_run

        assert open_run(config).path.is_dir()
        unknown_scene(config)

    job(refuse)
    assert launch("+exp=train")[0] == 2
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_used_is_named_with_what_to_do(launch, job):
    def denied(config):
        raise PermissionError(errno.EACCES, "Permission denied", "/elsewhere/file")

    job(denied)
    status, _, err = launch("+exp=train")
    assert status == 1
    rule = "give yourself the right to use it, and the same command continues"
    assert err == f"evade: failed: /elsewhere/file: Permission denied; {rule}\n"


def test_ctrl_c_ends_with_status_130_and_one_line(launch, job):
    # A background shell starts its children deaf to Ctrl+C; Python then makes no exception of it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    job(lambda config: signal.raise_signal(signal.SIGINT))
    try:
        status, _, err = launch("+exp=train")
    finally:
        signal.signal(signal.SIGINT, before)
    assert status == 130
    assert len(err.splitlines()) == 1


def test_every_job_has_an_experiment_that_runs_it(launcher):
    assert {compose(f"+exp={exp}")["job"] for exp in experiments()} == set(launcher.JOBS)


def test_the_launcher_says_so_when_conf_is_not_there(launch, launcher, monkeypatch, tmp_path):
    monkeypatch.setattr(launcher, "CONF", tmp_path / "conf")
    status, _, err = launch("+exp=train")
    assert status == 2
    assert "pip install -e ." in err


@pytest.mark.system
@pytest.mark.timeout(900)
def test_this_machine_gives_the_published_digits():
    result = shell(sys.executable, "-m", "platform.launch", "fingerprint")
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.rstrip().endswith("equal")
