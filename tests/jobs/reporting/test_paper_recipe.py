import shutil
from collections import Counter

import pytest

from jobs.analysis.tables import estimate_text
from jobs.config.config import as_dict, parse
from jobs.reporting import two_groups
from jobs.reporting.claims_study import BY_PPO, study_findings
from jobs.reporting.paper_claims import FASTER, OF_BOTH
from jobs.reporting.paper_recipe import PAPER, RECIPES, recipe_findings, results_text
from jobs.reporting.sweep_data import read_data, read_sweep
from jobs.run.files import read_json
from jobs.run.provenance import REPOSITORY
from jobs.studies.ablation.ablation import variant_config
from jobs.tools.curves import read_curves
from models.policy.policy import MANIFEST
from tests.support.configs import compose
from tests.support.sweep_folders import write_ablation, write_shipped


def study(folder, failed):
    return read_sweep(write_ablation(folder, PAPER, failed))


def learning_curves(data):
    """Curves beside policies, of the paper's recipe and of event images among others; returns `data`."""
    folder = write_shipped(data / f"{BY_PPO}_policies", before=f"{BY_PPO}_")
    table = (folder / "curves.csv").read_text().splitlines()
    own = [line.replace(f"{BY_PPO}_bytestream,", f"{PAPER}_bytestream_paper,") for line in table]
    (folder / "curves.csv").write_text("\n".join([*table, *own[1:]]) + "\n")
    for seed in (0, 1):
        shutil.copytree(folder / f"{BY_PPO}_bytestream-s{seed}", folder / f"{PAPER}_bytestream_paper-s{seed}")
        assert (folder / f"{PAPER}_bytestream_paper-s{seed}" / MANIFEST).is_file()
    return data


def page_text(name):
    """A page without its line breaks, which may stand anywhere."""
    return " ".join((REPOSITORY / "docs" / f"{name}.md").read_text().split())


def only_recipe_loses(group, axis, value, seed):
    """The paper's recipe fails in all episodes under false events, and nobody anywhere else."""
    return 14 * (group == RECIPES.tried and axis == "background_activity")


def test_its_trainings_are_those_of_the_experiment_of_that_name():
    """All that a training learns by and from; how often it is saved and validated may differ."""
    study = parse(compose(f"+exp={PAPER}"))
    ours = as_dict(variant_config(study, RECIPES.tried, 3))
    theirs = as_dict(parse(compose("+exp=bytestream_paper", "seed=3")))
    for section in ("model", "algo", "collect", "pretrain", "train", "env", "camera", "faults", "fidelity"):
        saved = {"checkpoint_every", "validate_every"}
        differ = {key for key, value in ours[section].items() if value != theirs[section][key]}
        assert differ <= saved, section


def test_the_other_trainings_and_the_conditions_are_those_of_the_papers_claims_by_ppo():
    study, claims = (parse(compose(f"+exp={name}")) for name in (PAPER, BY_PPO))
    assert study.sweep == claims.sweep
    assert study.ablation.seeds == claims.ablation.seeds
    for group in ("bytestream", "event_image"):
        ours, theirs = (as_dict(variant_config(config, group, 7)) for config in (study, claims))
        assert {key for key in ours if ours[key] != theirs[key]} <= {"exp", "ablation"}


def test_claims_are_of_the_papers_recipe_in_place_of_ours(tmp_path):
    about, episodes = study(tmp_path, only_recipe_loses)
    verdicts = {claim.text: one for claim, one in recipe_findings(tmp_path, about, episodes).items()}
    assert verdicts["tolerates background activity"].verdict == "reversed"
    assert verdicts["tolerates background activity"].overall.value == pytest.approx(-60.0)
    assert verdicts["tolerates dead pixels"].verdict == "equivalent"
    on_ours = {claim.text: one.verdict for claim, one in study_findings(about, episodes, []).items()}
    assert on_ours["tolerates background activity"] == "equivalent"


def test_the_claim_about_learning_is_tested_where_curves_are_published(tmp_path):
    about, episodes = study(tmp_path / "study", lambda *_: 0)
    without = {claim.text for claim in recipe_findings(tmp_path, about, episodes)}
    assert without == {text for text, *_ in OF_BOTH}
    found = recipe_findings(learning_curves(tmp_path), about, episodes)
    assert {claim.text for claim in found} == without | {FASTER}
    (faster,) = (one for claim, one in found.items() if claim.text == FASTER)
    assert faster.overall.value == pytest.approx(0.2)


def test_the_page_says_what_the_test_would_be_without_what_a_gpu_made():
    pairs = two_groups.overall(two_groups.pairs_of(RECIPES, *read_data(REPOSITORY / "docs" / "data", PAPER)))
    text = page_text(PAPER)
    for first, says in ((9, "difference would be {} points {}, and"), (6, "processors alone {} {}.")):
        found = two_groups.Pair(pairs.tried[:first], pairs.usual[:first]).difference()
        assert says.format(*estimate_text(found, 100, "+.0f").split(" ", 1)) in text


def test_the_readme_says_how_much_both_recipes_succeed():
    pairs = two_groups.pairs_of(RECIPES, *read_data(REPOSITORY / "docs" / "data", PAPER))
    tried, usual = (f"{100 * side.mean():.0f}" for side in two_groups.overall(pairs))
    text = " ".join((REPOSITORY / "README.md").read_text().split())
    assert f"recipe succeed in {tried} % over {len(pairs)} conditions, ten by ours in {usual} (" in text


def test_what_pages_say_of_the_recipe_is_what_the_data_say():
    """How the claims end, how the ten trainings end, and what their encoders explain."""
    data = REPOSITORY / "docs" / "data"
    verdicts = Counter(one.verdict for one in recipe_findings(data, *read_data(data, PAPER)).values())
    assert verdicts["holds"] == 0
    front = page_text("index")
    assert (
        f"{sum(verdicts.values())} claims on it none holds, and {verdicts['reversed']} is reversed" in front
    )
    policies = sorted(data.glob(f"{BY_PPO}_policies/{PAPER}_bytestream_paper-s*"))
    encoders = [read_json(policy / "encoder.json")["figures"] for policy in policies]
    explained = [round(100 * one["explained_loss_step"]) for one in encoders if not one["collapsed"]]
    assert len(policies) - len(explained) == 1
    assert f"collapsed, and the others explain {min(explained)} to {max(explained)} %" in front
    ends = [
        round(100 * curve.success_rate[-1])
        for (group, _), curve in read_curves(data / f"{BY_PPO}_policies").items()
        if group == f"{PAPER}_bytestream_paper"
    ]
    assert len(ends) == len(policies)
    assert f"end at {min(ends)} to {max(ends)} %" in page_text("representations")


def test_the_page_has_the_test_of_the_recipes_and_a_row_for_each_claim(tmp_path):
    about, episodes = study(tmp_path / "study", only_recipe_loses)
    text = results_text(about, episodes, learning_curves(tmp_path))
    recipes, claims = text.split("### ")
    assert recipes.rstrip() == two_groups.results_text(RECIPES, about, episodes)
    rows = [line for line in claims.splitlines() if line.startswith("| `bytestream_paper`")]
    assert len(rows) == 8
    assert sum("reversed" in row for row in rows) == 1
