#!/usr/bin/env bash
# Build the image without a registry or a daemon, and run its commands: make test-image
#
# A base made by debootstrap stands for python:3.11-slim-bookworm; buildah builds and runs by chroot. Needs root,
# debootstrap, buildah, 8 GB in $WORK (removed at the end). The words of the command go to `buildah build`, such as
# --build-arg PIP_EXTRA_INDEX_URL=... or --volume FOLDER:FOLDER:ro.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
WORK="${WORK:-$(mktemp -d)}"
BASE=docker.io/library/python:3.11-slim-bookworm
IMAGE=localhost/evade:test
STORE=(--root "$WORK/images" --runroot "$WORK/run" --storage-driver overlay)
ALONE=(--isolation chroot --network host)

clean() {
    buildah "${STORE[@]}" rm --all >/dev/null || true
    buildah "${STORE[@]}" rmi --all --force >/dev/null || true
    rm -rf "$WORK"
}
trap clean EXIT

base=$(buildah "${STORE[@]}" from scratch)
place=$(buildah "${STORE[@]}" mount "$base")
debootstrap --variant=minbase --include=ca-certificates,python-is-python3,python3,python3-venv bookworm "$place"
buildah "${STORE[@]}" umount "$base" >/dev/null
buildah "${STORE[@]}" commit --rm "$base" "$BASE"
buildah "${STORE[@]}" build "${ALONE[@]}" --pull-never "$@" --tag "$IMAGE" --file docker/Dockerfile \
    --ignorefile docker/Dockerfile.dockerignore .
buildah "${STORE[@]}" images

container=$(buildah "${STORE[@]}" from --pull-never "$IMAGE")
results=""
try() { # name, command: run a command of the image, and remember how it ended
    local began=$SECONDS ended=passed
    buildah "${STORE[@]}" run "${ALONE[@]}" "$container" -- bash -c "$2" || ended=FAILED
    results+="$1: $ended, $((SECONDS - began)) s"$'\n'
}
SMOKE="python -m platform.launch budget=smoke runs_dir=/runs/smoke tracking.uri=sqlite:////runs/mlflow.db"
try "user is not root" 'test "$(id -u)" = 1000 && test ! -w /etc && test -w /runs'
try "help" 'python -m platform.launch --help'
try "health" 'python -c "import envs, jobs, models"'
try "training" "$SMOKE +exp=event_columns job=train env.time_limit_s=1.0 train.env_steps=2048"
try "sweep" "$SMOKE +exp=robustness study.policies=[newest,oracle] model=event_columns env.time_limit_s=0.5 \
    ~study.axes '+study.axes.sparsity={faults.sparsity:[0.0,0.5]}'"
try "OpenGL" 'python -c "from envs.corridor import CorridorEnv; CorridorEnv(renderer=\"pyrender\").reset(seed=0)"'
# The server of the jobs above must answer by HTTP with the experiment that they wrote.
try "dashboard" 'mlflow server --workers 1 --host 127.0.0.1 --port 5055 --backend-store-uri sqlite:////runs/mlflow.db &
    for _ in $(seq 60); do sleep 2; python -c "
import urllib.request as r; place = \"http://127.0.0.1:5055/api/2.0/mlflow/experiments/get-by-name\"
assert b\"evade\" in r.urlopen(place + \"?experiment_name=evade\").read()" 2>/dev/null && break; done
    result=$?; kill %1; exit $result'
try "tests" "make test-again VENV=/opt/venv ARGS='${TESTS:-}'"
printf '%s' "$results"
[[ $results != *FAILED* ]]
