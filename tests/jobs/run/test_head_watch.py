import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.patience import HANG_S, breath_s

ROOT = Path(__file__).resolve().parents[3]
# In a process of its own, because the watch ends the process that it is in.
WATCHED = """
import time
from jobs.run import head_watch
head_watch.ASK_EVERY_S, head_watch.SILENCE_S, head_watch.LEAVE_S = 0.05, {silence}, 3 * {silence}
answers = {answers}
def ask(seconds):
    assert seconds == {silence} / 2
    return answers.pop(0) if answers else {then}
head_watch.head_answers, head_watch.ended_process = ask, lambda: {ended!r}
try:
    with head_watch.watching_head():
{work}
    print("done")
except head_watch.HeadLostError as error:
    print("told", error, flush=True)
    time.sleep({closing})
    print("closed")
"""
SILENCE_S = breath_s()
FOREVER = "time.sleep(3600)"
DEAF = """
while True:
    try:
        time.sleep(3600)
    except KeyboardInterrupt:
        pass
"""

pytestmark = pytest.mark.system


def watched(work=FOREVER, answers=(), then=False, closing=0, ended="", sigint=signal.default_int_handler):
    indented = "\n".join(f"        {line}" for line in work.strip().splitlines())
    told = {"answers": list(answers), "then": then, "closing": closing, "ended": ended}
    script = WATCHED.format(work=indented, silence=SILENCE_S, **told)
    command = [sys.executable, "-c", script]
    before = signal.signal(signal.SIGINT, sigint)  # what is ignored here is ignored in the process too
    try:
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=HANG_S)
    finally:
        signal.signal(signal.SIGINT, before)


def test_work_in_the_background_of_a_script_is_told_too_and_goes_on_ignoring_ctrl_c_until_then():
    signals = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nprint('ignored')\n"
    ended = watched(signals + FOREVER, sigint=signal.SIG_IGN)
    assert ended.stdout.startswith(f"ignored\ntold Ray's head has not answered for {SILENCE_S} s: ")
    assert ended.stdout.endswith("the same command continues\nclosed\n")
    assert (ended.stderr, ended.returncode) == ("", 0)


def test_work_that_waits_forever_for_a_lost_head_is_ended_with_the_same_reason():
    ended = watched(DEAF)
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"evade: failed: Ray's head has not answered for {SILENCE_S} s: ")
    assert ended.stderr.count("\n") == 1


def test_what_closes_forever_after_a_lost_head_is_ended_without_a_second_reason():
    ended = watched(closing=3600)
    assert (ended.returncode, ended.stderr) == (1, "")
    assert "closed" not in ended.stdout


def test_a_head_that_answers_or_answers_late_ends_nothing():
    for answers in ([], [True, False, True, False]):
        ended = watched(f"time.sleep({1.5 * SILENCE_S})", answers, then=True)
        assert (ended.stdout, ended.stderr, ended.returncode) == ("done\n", "", 0)


def test_work_whose_ray_has_ended_ends_at_once_with_the_reason():
    ended = watched(then=True, ended="raylet")
    assert ended.stdout.startswith("told Ray's process raylet has ended: ")
    assert (ended.stderr, ended.returncode) == ("", 0)


def test_ctrl_c_stays_ctrl_c():
    ended = watched("raise KeyboardInterrupt", then=True)
    assert "KeyboardInterrupt" in ended.stderr
    assert "told" not in ended.stdout
