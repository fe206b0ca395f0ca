import dataclasses
import json

import numpy as np
import pytest

from docs.from_data import figures
from jobs.config.config import as_dict, parse
from jobs.evaluation.group_stats import episode_values
from jobs.evaluation.sweep_plan import axes_of
from jobs.reporting.claims_study import (
    BY_PPO,
    TAUGHT,
    other_findings,
    published_studies,
    read_findings,
    study_findings,
    write_claims_study,
)
from jobs.reporting.paper_claims import CLAIMS, LEARNT
from jobs.reporting.planned_page import RESULTS
from jobs.reporting.report import claims_table, find_study
from jobs.reporting.sweep_data import read_sweep, read_sweep_episodes
from jobs.run.folder import COMPARED_STEPS
from jobs.run.provenance import REPOSITORY
from jobs.studies.ablation.ablation import trained_policies, variant_config
from tests.support.configs import compose, small_config
from tests.support.sweep_folders import write_claims, write_shipped

TEXTURES = "generalises to other textures"
TEXTS = {TAUGHT: "gains much over event images with moving textures", BY_PPO: "generalises to other shapes"}
PLAN = "# A plan\n\n- **Rule.** As it was.\n"


def test_the_study_trains_the_groups_of_the_claims_alike_and_evaluates_their_conditions():
    config = parse(compose("+exp=taught_claims"))
    axes, groups = axes_of(config.sweep), list(config.ablation.variants)
    own = [claim for claim in CLAIMS if {claim.ours, claim.theirs} <= set(groups)]
    assert len(own) == 15
    assert all(value in axes[axis] for claim in own for axis, value in claim.conditions)
    trained = {name: variant_config(config, name, 1) for name in groups}
    assert {name: one.model.name for name, one in trained.items()} == {name: name for name in groups}
    assert {one.model.stack for one in trained.values()} == {3}
    assert not any(getattr(one.model, "memory_ms", ()) for one in trained.values())
    assert len({json.dumps(dataclasses.asdict(one.env), sort_keys=True) for one in trained.values()}) == 1
    memory = {name: one.algo.imitation.keep_mb for name, one in trained.items()}
    assert memory["event_image"] * 1e6 > config.train.env_steps * (3 * 64 * 64 + 100)  # all of its pictures
    alike = [dataclasses.replace(one.algo.imitation, keep_mb=1) for one in trained.values()]
    algos = {
        str(dataclasses.asdict(dataclasses.replace(one.algo, lr=1.0, imitation=same)))
        for one, same in zip(trained.values(), alike, strict=True)
    }
    assert len(algos) == len({str(dataclasses.asdict(one.train)) for one in trained.values()}) == 1


def test_the_study_by_ppo_is_that_of_taught_policies_but_for_how_they_learn():
    taught, ppo = (parse(compose(f"+exp={name}")) for name in (TAUGHT, BY_PPO))
    assert (taught.sweep, taught.ablation.seeds) == (ppo.sweep, ppo.ablation.seeds)
    groups = {one for claim in (*CLAIMS, *LEARNT) for one in (claim.ours, claim.theirs)}
    assert set(taught.ablation.variants) < set(ppo.ablation.variants) == groups - {"rgb"}
    for name in taught.ablation.variants:
        one, other, usual = (
            as_dict(config)
            for config in (
                variant_config(ppo, name, 1),
                variant_config(taught, name, 1),
                parse(compose(f"+exp={name}")),
            )
        )
        for part in ("env", "model", "collect", "pretrain"):
            assert one[part] == other[part]
        assert one["model"] == usual["model"]
        searched = searched_rates(name)
        best = max(searched, key=lambda lr: (searched[lr].mean(), -lr)) if searched else usual["algo"]["lr"]
        assert one["algo"] == usual["algo"] | {"lr": best}
        assert one["train"]["env_steps"] == COMPARED_STEPS
        assert one["train"]["conditions"] == other["train"]["conditions"] == usual["train"]["conditions"]


def searched_rates(name):
    """Learning rate -> success of its trainings in validation corridors; empty: none was searched."""
    file = REPOSITORY / "docs" / "data" / f"learning_rates_{name}_episodes.csv.gz"
    if not file.is_file():
        return {}
    variants = parse(compose("+exp=learning_rates")).ablation.variants
    return {
        variants[group]["algo.lr"]: episode_values(trainings, "success").mean(axis=1)
        for (_, group), trainings in read_sweep_episodes(file).items()
    }


def test_the_trainings_by_ppo_are_those_of_the_plan():
    policies = REPOSITORY / "docs" / "data" / f"{BY_PPO}_policies"
    config = parse(compose(f"+exp={BY_PPO}", f"ablation.trained={policies}"))
    trained = trained_policies(config)
    assert len(trained) == 40
    assert set(trained.values()) == {found.parent for found in policies.glob(f"{BY_PPO}_*/policy.json")}


def test_the_page_shows_the_learning_rates_that_were_searched():
    text, _ = (REPOSITORY / "docs" / "ppo_claims.md").read_text().split("## Plan")
    files = (REPOSITORY / "docs" / "data").glob("learning_rates_*_episodes.csv.gz")
    kinds = [file.name.removeprefix("learning_rates_").removesuffix("_episodes.csv.gz") for file in files]
    shown = set()
    for kind in kinds:
        searched = searched_rates(kind)
        best = max(searched, key=lambda lr: (searched[lr].mean(), -lr))
        cells = []
        for lr in sorted(searched):
            mean, each = f"{100 * searched[lr].mean():.0f}", (f"{100 * one:.0f}" for one in searched[lr])
            cells.append(f"{f'**{mean}**' if lr == best else mean} ({', '.join(each)})")
        shown.add(f"| `{kind}` | {' | '.join(cells)} |")
    assert shown == {line for line in text.splitlines() if line.startswith("| `")}


def test_a_loss_of_the_rival_alone_shows_in_the_claims_about_it_and_in_no_other(tmp_path):
    even = study_findings(*read_sweep(write_claims(tmp_path / "even", trainings=6)), ())
    assert len(even) == 15
    assert {one.overall.value for one in even.values()} == {0.0}
    lost = [("event_image", "world", "texture_change", 9)]
    findings = study_findings(*read_sweep(write_claims(tmp_path / "lost", lost, trainings=6)), ())
    changed = {claim.ours: one for claim, one in findings.items() if claim.text == TEXTURES}
    assert set(changed) == {"bytestream", "bytestream_xy"}
    for one in changed.values():
        assert (one.verdict, one.overall.value) == ("holds", pytest.approx(9 / 14))
    assert all(
        one.overall == even[claim].overall for claim, one in findings.items() if claim.text != TEXTURES
    )


def test_the_page_keeps_its_plan_and_is_written_again_the_same(tmp_path):
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / f"{TAUGHT}.md").write_text(PLAN)
    study = write_claims(tmp_path / "run" / "ablation", [("event_image", "world", "dynamic", 9)])
    page = write_claims_study(study, docs, TAUGHT)
    first = page.read_text()
    assert first.startswith(PLAN)
    assert first.count(RESULTS) == 1
    assert first.count("| `bytestream") >= 15
    assert write_claims_study(study, docs, TAUGHT).read_text() == first
    assert set(figures(docs / "data")) == {TAUGHT}


def test_each_study_is_shown_beside_the_other_way_to_learn(tmp_path):
    docs = tmp_path / "docs"
    docs.mkdir()
    study = {
        name: write_claims(tmp_path / name / "ablation", [("event_image", "world", value, 9)], name, 6)
        for name, value in ((TAUGHT, "dynamic"), (BY_PPO, "shape_change"))
    }
    assert other_findings(docs / "data", TAUGHT) == (BY_PPO, {})
    pages = {name: write_claims_study(study[name], docs, name) for name in (TAUGHT, BY_PPO, TAUGHT)}
    assert set(figures(docs / "data")) == {TAUGHT, BY_PPO}
    for name, other in ((TAUGHT, BY_PPO), (BY_PPO, TAUGHT)):
        beside, findings = other_findings(docs / "data", name)
        assert (beside, findings) == (other, read_findings(docs / "data", other))
        text = pages[name].read_text()
        assert f"({other}.md#results)" in text
        assert f"images/{name}.png" in text
        row = next(line for line in text.splitlines() if line.startswith(f"| `bytestream`: {TEXTS[other]}"))
        assert [cell.strip() for cell in row.split("|")][3:8:4] == ["equivalent", "holds"]
    studies = published_studies(docs / "data")
    head, _, *lines = claims_table(studies[TAUGHT], studies).splitlines()
    assert head.endswith("| By PPO | Taught |")
    row = next(line for line in lines if line.startswith(f"| `bytestream`: {TEXTS[TAUGHT]}"))
    assert row.endswith("| equivalent | holds |")


def test_how_fast_groups_learn_is_tested_where_a_study_has_learning_curves(tmp_path):
    data = tmp_path / "data"
    write_claims_study(write_claims(tmp_path / "run" / "ablation", (), BY_PPO), tmp_path, BY_PPO)
    assert len(read_findings(data, BY_PPO)) == 16
    write_shipped(data / f"{BY_PPO}_policies", f"{BY_PPO}_")
    found = read_findings(data, BY_PPO)
    assert len(found) == 17
    assert found[LEARNT[0]].overall.value == pytest.approx((0.805 - 0.405) / 2)


def test_the_published_study_by_ppo_has_all_the_tests_of_its_plan():
    found = read_findings(REPOSITORY / "docs" / "data", BY_PPO)
    assert len(found) == 18
    assert set(LEARNT) < set(found)


def test_only_a_study_of_this_name_is_reported(tmp_path):
    study = write_claims(tmp_path / "a" / "ablation")
    config = dataclasses.replace(small_config(tmp_path), runs_dir=str(tmp_path))
    assert find_study(config, TAUGHT) == study
    about = json.loads((study / "about.json").read_text())
    (study / "about.json").write_text(json.dumps(about | {"exp": "ablation"}))
    assert find_study(config, TAUGHT) is None


def test_the_constructed_study_loses_what_it_is_told_to(tmp_path):
    _, episodes = read_sweep(write_claims(tmp_path, [("bytestream", "sparsity", "0.5", 4)]))
    rates = {place: np.mean([own["success"].sum() for own in of.values()]) for place, of in episodes.items()}
    usual = rates[("sparsity", "0.2"), "bytestream"]
    assert rates[("sparsity", "0.5"), "event_image"] == usual > 13
    assert rates[("sparsity", "0.5"), "bytestream"] == pytest.approx(usual - 4)
