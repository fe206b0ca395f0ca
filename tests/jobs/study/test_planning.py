import pytest

from jobs.study.planning import main, plan_rows


def test_every_claim_of_the_published_study_is_planned():
    rows = plan_rows("taught_claims", 10, 28)
    assert "bytestream: tolerates dead pixels" in {row[0] for row in rows}
    assert len(rows) == 15 + 12 + 4  # the claims, by the other account, and over all conditions
    assert all(row[-1].startswith("±") for row in rows)


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (("taught_claims", "1", "28"), "trainings: must be a whole number, two at least, got '1'"),
        (("taught_claims", "10", "many"), "corridors: must be a whole number, two at least, got 'many'"),
        (("moon", "10", "28"), "invalid choice: 'moon'"),
    ],
)
def test_wrong_words_are_refused_with_the_rule(words, rule, capsys):
    with pytest.raises(SystemExit):
        main(words)
    assert rule in capsys.readouterr().err
