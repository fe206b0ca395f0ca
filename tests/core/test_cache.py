import os
import sys
import types
from pathlib import Path

import pytest

from core import cache

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def denied(monkeypatch, tmp_path):
    """An installation that cannot be written, without a home, and a temporary folder of the test's own."""
    monkeypatch.setenv(cache.VARIABLE, "")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", "/nonexistent")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setitem(sys.modules, "numba.core.config", types.SimpleNamespace())
    writable = {str(tmp_path)}
    monkeypatch.setattr(cache.os, "access", lambda path, mode: str(path) in writable)
    return writable


def test_without_a_home_a_read_only_installation_compiles_into_a_private_folder(denied, tmp_path):
    cache.choose_cache(ROOT)
    chosen = Path(os.environ[cache.VARIABLE])
    assert chosen.is_dir()
    assert chosen.parent == tmp_path / f"evade-{os.getuid()}"
    assert chosen.parent.stat().st_mode & 0o777 == 0o700
    before = os.environ.pop(cache.VARIABLE)
    cache.choose_cache(ROOT)
    assert os.environ[cache.VARIABLE] == before


def test_other_users_cannot_plant_a_folder_that_numba_would_unpickle(denied, tmp_path):
    (tmp_path / f"evade-{os.getuid()}").mkdir(mode=0o777)
    (tmp_path / f"evade-{os.getuid()}").chmod(0o777)
    cache.choose_cache(ROOT)
    chosen = Path(os.environ[cache.VARIABLE])
    assert chosen.parent.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("reason", ["the user's choice", "a source folder", "a home"])
def test_numba_keeps_its_own_place_where_it_has_one(denied, tmp_path, monkeypatch, reason):
    if reason == "the user's choice":
        monkeypatch.setenv(cache.VARIABLE, "/chosen")
    elif reason == "a source folder":
        denied.add(str(ROOT / "envs"))
    else:
        monkeypatch.setenv("HOME", str(tmp_path))
    cache.choose_cache(ROOT)
    assert os.environ[cache.VARIABLE] == ("/chosen" if reason == "the user's choice" else "")
    assert not (tmp_path / f"evade-{os.getuid()}").exists()


def test_without_home_no_folder_of_the_name_of_a_home_is_taken(denied, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")  # relative: it would lie in the current folder
    cache.choose_cache(ROOT)
    assert Path(os.environ[cache.VARIABLE]).is_absolute()
