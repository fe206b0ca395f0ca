"""The files of docker/, read as the programs that they are for read them; no engine is needed."""

import json
import re
import shlex
import sys
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

from jobs.config.config import parse

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
LOCK = dict(
    line.split("==") for line in (ROOT / "requirements.lock").read_text().splitlines() if "==" in line
)
ADDED = [line for line in (DOCKER / "requirements.txt").read_text().splitlines() if line[:1] != "#"]
DOCKERFILE = (DOCKER / "Dockerfile").read_text()
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
CLUSTER = yaml.safe_load((DOCKER / "cluster.yaml").read_text())
RAYJOB, POLICY = yaml.safe_load_all((DOCKER / "rayjob.yaml").read_text())
VERSION = re.search(r'^version = "(.+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)[1]
RAY_CLUSTER = RAYJOB["spec"]["rayClusterSpec"]
PODS = [RAY_CLUSTER["headGroupSpec"]["template"], *(g["template"] for g in RAY_CLUSTER["workerGroupSpecs"])]


def instructions() -> list[tuple[str, str]]:
    """The Dockerfile's instructions, each with the text behind it."""
    text = re.sub(r"^\s*#.*\n", "", DOCKERFILE, flags=re.MULTILINE).replace("\\\n", " ")
    return [
        (line.partition(" ")[0], line.partition(" ")[2].strip()) for line in text.splitlines() if line.strip()
    ]


def commands() -> list[list[str]]:
    """Every command of ours that a container, a node or a job runs, as words."""
    texts = [*CLUSTER["head_start_ray_commands"], *CLUSTER["worker_start_ray_commands"]]
    texts.append(RAYJOB["spec"]["entrypoint"])
    lists = [pod["spec"]["containers"][0]["readinessProbe"]["exec"]["command"] for pod in PODS]
    for name, service in SERVICES.items():
        command = service.get("command", [])
        texts += [command[2]] if command[:2] == ["sh", "-c"] else []
        lists += [command] if command and command[:2] != ["sh", "-c"] else []
        lists += [service["healthcheck"]["test"][1:]] if name != "db" else []
    lists += [
        json.loads(text[text.index("[") :]) for name, text in instructions() if name in ("CMD", "HEALTHCHECK")
    ]
    parts = [part.strip() for text in texts for part in text.split("&&")]
    return lists + [
        shlex.split(re.sub(r'^PGPASSWORD="[^"]*" ', "", part).removeprefix("exec ")) for part in parts
    ]


def test_every_added_package_is_pinned_and_agrees_with_the_lock():
    assert sorted(ADDED) == ADDED
    pins = {Requirement(line).name: line.partition("==")[2] for line in ADDED}
    assert all(re.fullmatch(r"[a-z0-9-]+==[0-9][a-z0-9.]*", line) for line in ADDED)
    assert not pins.keys() & LOCK.keys()
    assert {"psycopg", "psycopg-binary", "grpcio", "aiohttp-cors"} <= pins.keys()
    assert RAY_CLUSTER["rayVersion"] == LOCK["ray"]


def test_the_image_is_built_from_what_is_there_by_who_is_not_root():
    steps = instructions()
    stages = [text.split()[0] for name, text in steps if name == "FROM"]
    assert stages == ["python:3.11-slim-bookworm"] * 2
    copied = [text.split() for name, text in steps if name == "COPY" and "--from" not in text]
    sources = [word for words in copied for word in words[:-1] if not word.startswith("--")]
    assert [source for source in sources if not (ROOT / source).exists()] == []
    users = [text for name, text in steps if name == "USER"]
    assert users == ["$UID"]
    assert ("ARG", "UID=1000") in steps
    as_user = steps[steps.index(("USER", "$UID")) :]
    assert not any("apt-get" in text or "useradd" in text for _, text in as_user)
    packages = re.search(r"^GL_PACKAGES := (.+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1].split()
    assert all(f" {package} " in DOCKERFILE.replace("\n", " ") for package in packages)
    assert any(name == "HEALTHCHECK" for name, _ in steps)


def test_only_what_is_named_gets_into_the_image():
    lines = re.sub(
        r"^#.*\n", "", (DOCKER / "Dockerfile.dockerignore").read_text(), flags=re.MULTILINE
    ).split()
    assert lines[0] == "*"
    named = [line[1:] for line in lines if line.startswith("!")]
    assert [name for name in named if not (ROOT / name).exists()] == []
    assert lines.index("docker/secrets") > lines.index("!docker")
    if (ROOT / ".gitignore").is_file():  # it is not in the image
        assert "/docker/secrets/" in (ROOT / ".gitignore").read_text().splitlines()


def test_images_have_versions_and_ours_has_the_projects():
    used = {service["image"] for service in SERVICES.values()} | {CLUSTER["docker"]["image"]}
    used |= {container["image"] for pod in PODS for container in pod["spec"]["containers"]}
    assert {image for image in used if image.startswith("evade")} == {f"evade:{VERSION}"}
    assert all(re.search(r":\d+\.\d+", image) for image in used)


def test_ports_are_open_to_this_machine_only():
    ports = [port for service in SERVICES.values() for port in service.get("ports", [])]
    assert ports == ["127.0.0.1:5000:5000"]
    assert COMPOSE["networks"]["cluster"] == {"internal": True}
    outside = {name for name, service in SERVICES.items() if "outside" in service["networks"]}
    assert outside == {"mlflow"}
    assert "0.0.0.0" not in (DOCKER / "cluster.yaml").read_text() + (DOCKER / "rayjob.yaml").read_text()


def test_what_services_name_is_there():
    for name, service in SERVICES.items():
        assert set(service["secrets"]) <= set(COMPOSE["secrets"]), name
        assert set(service["networks"]) <= set(COMPOSE["networks"]), name
        assert {volume.partition(":")[0] for volume in service["volumes"]} <= set(COMPOSE["volumes"]), name
        for other, how in service.get("depends_on", {}).items():
            assert how == {"condition": "service_healthy"}
            assert "healthcheck" in SERVICES[other]
    text = json.dumps([service.get("command", []) for service in SERVICES.values()])
    hosts = set(re.findall(r"(?:=|@|//|,| )([a-z]+):\d{4}", text)) - {"localhost"}
    assert hosts == {"head", "mlflow", "db"} <= set(SERVICES)
    build = SERVICES["head"]["build"]
    assert (DOCKER / build["context"] / build["dockerfile"]).is_file()
    assert set(re.findall(r"^ARG (\w+)", DOCKERFILE, re.MULTILINE)) == set(build["args"])


NO_SECRET = r'token|false|"\$\$\(cat|.*(/run/secrets/|/\.ray/|/secrets\}/)\w+'  # a mode or a place


def test_no_file_holds_a_secret():
    for path in DOCKER.iterdir():
        if path.is_dir():
            continue
        text = re.sub(r"\s*#.*", "", path.read_text())
        found = re.findall(r"(?i)(?:password|token)\w*[\"']?[ \t]*[:=][ \t]*([^\s,}]+)", text)
        assert [word for word in found if not re.fullmatch(NO_SECRET, word)] == [], path.name
    assert {secret["file"] for secret in COMPOSE["secrets"].values()} == {
        "${EVADE_SECRETS:-./secrets}/ray_token", "${EVADE_SECRETS:-./secrets}/postgres_password"
    }  # fmt: skip


def test_every_ray_asks_for_the_token():
    for name in ("head", "worker", "example"):
        environment = SERVICES[name]["environment"]
        assert environment["RAY_AUTH_MODE"] == "token"
        assert environment["RAY_AUTH_TOKEN_PATH"] == f"/run/secrets/{SERVICES[name]['secrets'][0]}"
    token = f"--env=RAY_AUTH_TOKEN_PATH={next(iter(CLUSTER['file_mounts']))}"
    assert {"--env=RAY_AUTH_MODE=token", token} <= set(CLUSTER["docker"]["run_options"])
    assert RAY_CLUSTER["authOptions"] == {"mode": "token", "secretName": "evade-ray-token"}
    assert "RAY_AUTH_MODE=token" in DOCKERFILE


def test_our_containers_run_without_privileges():
    ours = [service for service in SERVICES.values() if service["image"].startswith("evade")]
    assert all(service["cap_drop"] == ["ALL"] for service in ours)
    assert all(service["security_opt"] == ["no-new-privileges:true"] for service in SERVICES.values())
    for pod in PODS:
        assert pod["spec"]["securityContext"]["runAsNonRoot"]
        assert pod["spec"]["securityContext"]["runAsUser"] == 1000
        (container,) = pod["spec"]["containers"]
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}
        }  # fmt: skip
        claimed = {volume["name"] for volume in pod["spec"]["volumes"]}
        assert {mount["name"] for mount in container["volumeMounts"]} == claimed
        assert pod["metadata"]["labels"].items() >= POLICY["spec"]["podSelector"]["matchLabels"].items()


def test_the_launchers_file_is_valid_to_ray():
    from ray.autoscaler._private.util import prepare_config, validate_config

    validate_config(prepare_config(CLUSTER))
    with pytest.raises(Exception, match="colour"):
        validate_config(prepare_config({**CLUSTER, "colour": "red"}))


@pytest.fixture
def compose_configuration(launcher, monkeypatch):
    """What the launcher makes of the words of a command."""

    def compose(words: list[str]):
        monkeypatch.setattr(sys, "argv", ["evade", *words])
        return parse(launcher.compose(words))

    return compose


def test_every_command_is_one_that_its_program_takes(compose_configuration):
    import mlflow.cli
    from ray.scripts.scripts import cli as ray

    seen = set()
    for words in commands():
        words = [word.replace("$RAY_HEAD_IP", "10.0.0.1") for word in words]
        program = words[0] if words[0] != "python" else " ".join(words[:2])
        seen.add(program)
        if words[:1] == ["ray"]:
            ray.commands[words[1]].make_context(words[1], words[2:])
        elif words[:1] == ["mlflow"]:
            mlflow.cli.cli.commands["server"].make_context("server", words[2:])
        elif words[:3] == ["python", "-m", "platform.launch"] and words[3:] != ["--help"]:
            config = compose_configuration(words[3:])
            assert (config.cluster.name, config.runs_dir) == ("ray", "/runs")
            assert config.tracking.uri == "http://mlflow:5000"
        elif words[:2] == ["python", "-c"]:
            compile(words[2], "health check", "exec")
        else:
            assert words in (["cd", "/evade"], ["python", "-m", "platform.launch", "--help"])
    assert seen == {"ray", "mlflow", "python -m", "python -c", "cd"}
    assert {"ray", "mlflow"} <= set(LOCK)  # so that the image has these programs


def test_the_jobs_that_try_the_image_are_configurations_of_one_store(compose_configuration):
    script = (DOCKER / "test_image.sh").read_text().replace("\\\n", " ")
    (smoke,) = re.findall(r'^SMOKE="(.+)"$', script, re.MULTILINE)
    tried = dict(re.findall(r'^try "(.+?)" "\$SMOKE (.+)"$', script, re.MULTILINE))
    configs = {what: compose_configuration(shlex.split(f"{smoke} {tried[what]}")[3:]) for what in tried}
    assert [config.job for config in configs.values()] == ["train", "study"]
    assert {config.runs_dir for config in configs.values()} == {"/runs/smoke"}
    (store,) = {config.tracking.uri for config in configs.values()}
    assert f"--backend-store-uri {store} " in script
    (step,) = [text for name, text in instructions() if "useradd" in text]
    assert "--owner=evade /runs " in step
