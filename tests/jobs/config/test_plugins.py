import importlib
import sys

import numpy as np
import pytest
import trimesh

from envs.config import EnvConfig, FaultsConfig
from envs.corridor import CorridorEnv
from envs.scene import LAYOUTS, make_scene
from jobs.config import plugins
from jobs.config.conditions import axis_errors, condition_errors
from jobs.config.config import ConfigError, as_dict, parse
from jobs.config.env_keys import env_with
from jobs.rollout.met import met
from jobs.run.folder import run_name
from tests.support.configs import compose, small_config

HEAD = "from envs.config import ADDED_FAULTS\nfrom envs.scene.layouts import LAYOUTS, Layout, MeshLayout\n"
ADDS = HEAD + "from models.kinds import KINDS, DenseModel, Kind\n"
LOSE = """
def lose(amount, shape, rng):
    return lambda events, *rest: events[rng.random(events.size) >= amount]
ADDED_FAULTS["lose"] = lose
"""
GROVE = "LAYOUTS['grove'] = Layout(num_obstacles=5)\n"


@pytest.fixture(autouse=True)
def as_before(monkeypatch):
    """Forget every plug-in after a test."""
    known = {what: dict(rows) for what, rows in plugins.ROWS.items()}
    modules = set(sys.modules)
    monkeypatch.setattr(plugins, "_loaded", {})
    yield
    for what, rows in plugins.ROWS.items():
        rows.clear()
        rows.update(known[what])
    for name in set(sys.modules) - modules:
        if name.startswith("own_"):
            del sys.modules[name]


@pytest.fixture
def write(tmp_path):
    def write(text: str, name: str = "own_plugin.py") -> str:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return write


@pytest.mark.parametrize("form", ["file", "folder", "module"])
def test_a_file_a_package_and_a_module_add_what_every_job_finds_by_name(write, tmp_path, monkeypatch, form):
    name = {"file": "own_plugin.py", "folder": "own_plugin/__init__.py", "module": "own_plugin.py"}[form]
    path = write(HEAD + LOSE + GROVE, name)
    monkeypatch.syspath_prepend(str(tmp_path)) if form == "module" else None
    named = {"file": path, "folder": str(tmp_path / "own_plugin"), "module": "own_plugin"}[form]
    values = compose(*VALUES)
    with pytest.raises(ConfigError, match=r"faults\.added.*a plug-in, and none is loaded, got 'lose'"):
        parse(values)
    for _ in range(2):  # a second configuration of the same process
        config = parse({**values, "plugins": [named]})
    assert config.env.faults.added == {"lose": 0.5}
    assert len(make_scene("grove", np.random.default_rng(0)).obstacles) == 5
    assert parse(as_dict(config)) == config


def test_a_mesh_beside_its_package_is_the_scene_of_its_path(write, tmp_path):
    file = tmp_path / "own_hall" / "box.stl"
    path = write(HEAD + f"LAYOUTS['hall'] = MeshLayout(file={str(file)!r})\n", "own_hall/__init__.py")
    trimesh.creation.box((2.0, 2.0, 4.0)).apply_translation((0.0, 50.0, 2.0)).export(file)
    plugins.load_plugins([path.removesuffix("/__init__.py")])
    named, by_path = (make_scene(name, np.random.default_rng(0), width_m=40) for name in ("hall", str(file)))
    assert (named.name, by_path.name) == ("hall", str(file))
    assert all(np.array_equal(*pair) for pair in zip(named.mesh, by_path.mesh, strict=True))
    assert named.width_m == by_path.width_m == 40


VALUES = ("+exp=train", "env.scene=grove", "+faults.added.lose=0.5")


@pytest.fixture
def install(write, tmp_path, monkeypatch):
    """Install a distribution with one module and its entry points, as pip leaves it on disk."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def install(distribution: str, module: str, text: str, **points: str) -> None:
        write(text, f"{module}.py")
        folder = f"{distribution}-1.0.dist-info"
        write(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n", f"{folder}/METADATA")
        lines = [f"{name} = {value}" for name, value in points.items()]
        write("\n".join([f"[{plugins.GROUP}]", *lines]), f"{folder}/entry_points.txt")

    return install


def test_an_installed_package_is_named_by_its_entry_point(install, tmp_path):
    install("own_dist", "own_module", HEAD + LOSE + GROVE, groves="own_module")
    runs = set()
    for name in ("groves", "own_module", str(tmp_path / "own_module.py")):  # all the same plug-in
        config = parse({**compose(*VALUES), "plugins": [name]})
        runs.add(run_name(config))
        assert list(plugins.plugin_digests()) == ["own_module"]
    assert len(runs) == 1
    told = plugins.with_plugins({})
    assert told["env_vars"] == {plugins.VARIABLE: "own_module"}
    assert told["py_modules"] == [str(tmp_path / "own_module.py")]


def test_an_entry_point_that_leads_nowhere_is_refused_by_its_name(install):
    install("own_one", "own_module", HEAD + GROVE, twice="own_module", good="own_module")
    install("own_two", "own_other", "1 / 0\n", twice="own_other", called="own_other:main", broken="own_other")
    said = {
        "twice": r"must name one module, got own_module, own_other$",
        "called": r"must name one module, got own_other:main$",
        "broken": r"ZeroDivisionError: division by zero \(plug-in own_other, line 1\)$",
        "own_absent": r"must be a path, a module or an entry point .*: .*broken, called, good, twice",
    }
    for name, message in said.items():
        with pytest.raises(ConfigError, match=rf"^plugins: {name}: .*{message}"):
            plugins.load_plugins([name])
        assert plugins.plugin_digests() == {}
    plugins.load_plugins(["good"])
    assert "grove" in LAYOUTS


@pytest.mark.parametrize("name", ["own_folder", "own_folder.own_module"])
def test_a_folder_without_init_is_refused_as_nothing_of_it_could_be_shipped(
    write, tmp_path, monkeypatch, name
):
    write(HEAD + GROVE, "own_folder/own_module.py")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match=rf"^plugins: {name}: .*'own_folder'.*add an __init__\.py"):
        plugins.load_plugins([name])
    assert plugins.with_plugins({}) == {}
    write("", "own_folder/__init__.py")
    for known in [known for known in sys.modules if known.startswith("own_folder")]:
        monkeypatch.delitem(sys.modules, known)
    importlib.invalidate_caches()
    plugins.load_plugins(["own_folder.own_module"])
    assert "grove" in LAYOUTS


REFUSED = {
    "no such file": (None, "must be a module, a .py file or the folder of a package"),
    "what Python refuses": ("1 / 0\n", r"ZeroDivisionError: division by zero \(plug-in own_plugin, line 1\)"),
    "a name that is taken": (HEAD + "LAYOUTS['poles'] = Layout()\n", "replaces the scene 'poles'"),
    "a value out of range": (HEAD + "LAYOUTS['thin'] = Layout(width_m=2.0)\n", "width_m must be > 20"),
    "a scene that nothing can pass": (
        HEAD + "LAYOUTS['wall'] = Layout(num_obstacles=300, radius_min_m=1.0, radius_max_m=1.0)\n",
        "its scene 'wall': layout",
    ),
    "no function": (HEAD + "ADDED_FAULTS['lose'] = 0.5\n", "its fault 'lose': must be a function, got 0.5"),
    "no kind": (ADDS + "KINDS['blind'] = 7\n", "its kind of policy 'blind': 'int' object has no attribute"),
    "no such feature": (
        ADDS + "KINDS['blind'] = Kind('window', 'own_plugin:NONE', 'own_plugin:NONE', DenseModel)\n",
        "its kind of policy 'blind': module 'own_plugin' has no attribute 'NONE'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_used_is_refused_by_name_and_leaves_nothing(write, tmp_path, what):
    text, message = REFUSED[what]
    path = str(tmp_path / "own_plugin.py") if text is None else write(text)
    before = {key: dict(rows) for key, rows in plugins.ROWS.items()}
    with pytest.raises(ConfigError, match=rf"^plugins: .*own_plugin\.py: .*{message}"):
        plugins.load_plugins([path])
    assert before == plugins.ROWS
    if text is not None:  # mended, it is loaded by the same process
        write(HEAD + GROVE)
        plugins.load_plugins([path])
        assert "grove" in LAYOUTS


def test_a_file_may_not_take_the_name_of_another_module(write):
    for name in ("json.py", "colorsys.py", "envs.py"):
        with pytest.raises(ConfigError, match="is that of another module; rename it"):
            plugins.load_plugins([write(HEAD, name)])


def test_its_fault_follows_the_others_draws_after_them_and_changes_nothing_where_it_is_not_named(write):
    def events_of(**faults) -> list[list[tuple]]:
        env = CorridorEnv(EnvConfig(observation="events", faults=FaultsConfig(**faults)))
        env.reset(seed=3)
        return [list(map(tuple, env.step(1)[0].tolist())) for _ in range(4)]

    plain, noisy = events_of(), events_of(background_activity=0.5)
    plugins.load_plugins([write(HEAD + LOSE)])
    assert events_of(added={"lose": 0.0}) == events_of() == plain
    assert events_of(background_activity=0.5, added={"lose": 0.0}) == noisy
    assert events_of(added={"lose": 1.0}) == [[]] * 4
    half = events_of(added={"lose": 0.5})
    assert events_of(added={"lose": 0.5}) == half != plain
    for left, whole in zip(half, plain, strict=True):
        assert set(left) <= set(whole)
        assert 0.3 < len(left) / len(whole) < 0.7


WRONG = {
    "events[::-1]": "sorted by t",
    "events['t']": r"must return EVENT \(N,\), got ndarray int64",
    "np.array([(t1 + 1, 0, 0, 1)], events.dtype)": "with t in",
    "np.array([(t1, 64, 0, 1)], events.dtype)": "inside an image of 64 x 64",
    "np.array([(t1, 0, 0, 2)], events.dtype)": "with p in",
}


@pytest.mark.parametrize("code", WRONG)
def test_what_a_fault_returns_is_checked(write, code):
    wrong = f"ADDED_FAULTS['wrong'] = lambda *made: lambda events, t0, t1: {code}\n"
    plugins.load_plugins([write(HEAD + "import numpy as np\n" + wrong)])
    env = CorridorEnv(EnvConfig(faults=FaultsConfig(added={"wrong": 1.0})))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"fault 'wrong' of own_plugin .*{WRONG[code]}|{WRONG[code]}"):
        env.step(0)


def test_its_fault_is_a_setting_of_axes_and_conditions(write):
    plugins.load_plugins([write(HEAD + LOSE)])
    env, key = EnvConfig(), "faults.added.lose"
    assert axis_errors({"lost": {key: [0.0, 0.5]}}, env) == []
    assert condition_errors("train.conditions", [{key: {"low": 0.0, "high": 0.9}}], env) == []
    (error,) = axis_errors({"lost": {"faults.added.loose": [0.5]}}, env)
    assert "must be one of lose, got 'loose'" in error
    changed = env_with(env_with(env, {key: 0.2}), {"faults.sparsity": 0.1, key: 0.4})
    assert (changed.faults.sparsity, changed.faults.added) == (0.1, {"lose": 0.4})
    drawn = [{key: {"low": 0.0, "high": 0.5}}]
    assert [met(drawn, env, env, env_with(env, {key: amount})) for amount in (0.4, 0.6)] == [True, False]


def test_another_content_is_another_experiment_and_a_name_alone_is_none(write, tmp_path):
    plain = small_config(tmp_path)
    path = write(HEAD + GROVE)
    one = run_name(small_config(tmp_path, plugins=[path]))
    assert one != run_name(plain)
    write(HEAD + GROVE + "# changed\n")
    assert run_name(small_config(tmp_path, plugins=[path])) not in (one, run_name(plain))
    named = small_config(tmp_path, name="mine")
    assert run_name(named).startswith("mine-smoke-s0-")
    assert named.exp == "mine"


def test_ray_gets_what_it_had_without_a_plug_in_and_their_files_with_one(write, monkeypatch):
    before = {"env_vars": {"A": "1"}}
    assert plugins.with_plugins(before) == before
    path = write(HEAD + GROVE)
    plugins.load_plugins([path])
    told = plugins.with_plugins(before)
    assert told["py_modules"] == [path]
    assert told["env_vars"] == {"A": "1", plugins.VARIABLE: "own_plugin"}
    module, _, name = told["worker_process_setup_hook"].rpartition(".")
    assert getattr(sys.modules[module], name) is plugins.load_in_worker


def test_a_worker_that_cannot_import_one_says_so_when_its_content_is_asked_for(monkeypatch, capsys):
    monkeypatch.setenv(plugins.VARIABLE, "own_missing")
    plugins.load_in_worker()
    assert "plugins: own_missing: ModuleNotFoundError" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="plugins: own_missing: ModuleNotFoundError"):
        plugins.plugin_digests()


def test_an_error_names_the_plug_in_that_it_passed_through_and_no_other(write):
    path = write(HEAD + "def broken():\n    raise KeyError('gone')\n")
    plugins.load_plugins([path])
    with pytest.raises(KeyError) as raised:
        sys.modules["own_plugin"].broken()
    assert plugins.one_line(raised.value) == "KeyError: 'gone' (plug-in own_plugin, line 4)"
    assert plugins.one_line(KeyError("gone")) == "KeyError: 'gone'"
    trace = 'File "/tmp/ray/session_1/py_modules_files/_ray_pkg_1/own_plugin.py", line 9, in f'
    assert plugins.with_culprit("KeyError", trace) == "KeyError (plug-in own_plugin, line 9)"
    assert plugins.with_culprit("KeyError", trace.replace("own_plugin", "my_own_plugin")) == "KeyError"


ODD = """
import numpy as np
from torch import nn
from models.kinds import KINDS, FixedModel, Kind
from models.policy.features import Feature
def feature(windows, spec, encoder):
    return {made}
def network(shape, spec):
    return {parts}
ODD = Feature(np.float32, lambda spec: (2,), feature, None)
KINDS["odd"] = Kind("window", "own_odd:ODD", "own_odd:network", FixedModel)
"""
GOOD = "np.ones((len(windows), 2), np.float32)"
LAYERS = "nn.Flatten(), nn.Linear(6, 3), nn.Linear(6, 1)"


@pytest.mark.parametrize(
    ("made", "parts", "message"),
    [
        (GOOD, LAYERS, None),
        ("np.ones((len(windows), 3), np.float32)", LAYERS, r"its feature must be float32 \(3, 2\), got"),
        ("np.full((len(windows), 2), np.nan, np.float32)", LAYERS, "its feature must be finite, got NaN"),
        ("[[1.0, 1.0]]", LAYERS, r"its feature must be float32 \(3, 2\), got list"),
        ("windows.nothing", LAYERS, "AttributeError: .*plug-in own_odd, line 7"),
        (GOOD, "nn.Flatten(), nn.Linear(6, 4), nn.Linear(6, 1)", r"its logits must be float32 \(3, 3\)"),
        (GOOD, "nn.Flatten(), nn.Linear(6, 3), nn.Linear(6, 2)", r"its value must be float32 \(3, 1\)"),
        (GOOD, "nn.Flatten(), nn.Linear(5, 3), nn.Linear(6, 1)", "RuntimeError"),
    ],
)
def test_a_feature_or_a_network_that_cannot_work_is_refused_by_its_name_at_the_start(
    write, made, parts, message
):
    path = write(ODD.format(made=made, parts=parts), "own_odd.py")
    values = compose("+exp=train", "model=event_image")
    values = {**values, "plugins": [path], "model": {"name": "odd", "stack": 3}}
    if message is None:
        parse(values)
        return
    with pytest.raises(ConfigError, match=rf"^model\.name: 'odd' of plug-in own_odd: {message}"):
        parse(values)


def test_a_worker_takes_a_plug_in_from_where_it_was_shipped(write, tmp_path, monkeypatch):
    """Its path is the driver's: relative, or of a file that lies elsewhere in the worker."""
    write(HEAD + GROVE, "shipped/own_grove.py")
    monkeypatch.syspath_prepend(str(tmp_path / "shipped"))
    monkeypatch.setenv(plugins.VARIABLE, "own_grove")
    plugins.load_in_worker()
    for path in ("own_grove.py", str(tmp_path / "elsewhere" / "own_grove.py")):
        plugins.load_plugins([path])
    with pytest.raises(ConfigError, match="own_other"):
        plugins.load_plugins(["own_other.py"])


def test_a_plug_in_that_changed_since_a_training_is_named(write):
    path = write(HEAD + GROVE)
    plugins.load_plugins([path])
    digests = plugins.plugin_digests()
    assert plugins.changed_plugins(digests) == []
    assert plugins.changed_plugins({"own_plugin": "0" * 12, "never_loaded": "1" * 12}) == ["own_plugin"]
    write(HEAD + GROVE + "# another content\n")
    assert plugins.changed_plugins(digests) == ["own_plugin"]
