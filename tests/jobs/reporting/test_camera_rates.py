import pytest

from jobs.reporting.breaks import content
from jobs.reporting.camera_rates import compared, groups_of, measures, results_text
from jobs.reporting.sweep_data import read_data, read_sweep
from jobs.run.provenance import REPOSITORY
from tests.support.sweep_folders import write_ablation


def study(folder, failed):
    return read_sweep(write_ablation(folder, "camera_rates", failed))


def frames_lose_elsewhere(group, axis, value, seed):
    """Those trained by frames lose 6 of 14 at every rate but 200 Hz by their own camera."""
    return seed % 2 + 6 * (group.startswith("frames") and axis == "control_hz" and value != "200")


def test_each_group_has_five_rates_by_its_own_camera_and_three_by_the_other(tmp_path):
    groups = groups_of(*study(tmp_path, lambda group, axis, value, seed: seed))
    assert set(groups) == {(hz, camera) for hz in (45, 200, 400) for camera in ("pixels", "frames")}
    assert all(list(one.own) == [45, 100, 200, 400, 800] for one in groups.values())
    assert all(list(one.replaced) == [45, 200, 400] for one in groups.values())
    assert {values.shape for one in groups.values() for values in one.own.values()} == {(3, 14)}


def test_what_was_flown_with_nothing_changed_stands_for_no_rate(tmp_path):
    """A training at 45 Hz flies at 45 Hz with nothing changed, one at 400 Hz at 400 Hz."""
    groups = groups_of(*study(tmp_path, lambda group, axis, value, seed: 14 * (axis == "nominal")))
    assert all(values.all() for one in groups.values() for values in one.own.values())


def test_no_two_rates_of_the_published_trainings_are_the_same_flights():
    _, episodes = read_data(REPOSITORY / "docs" / "data", "camera_rates")
    for axis in ("control_hz", "pixels"):
        swept = [(group, content(own)) for (at, group), own in episodes.items() if at[0] == axis]
        assert len(set(swept)) == len(swept)


def test_a_loss_at_other_rates_is_that_of_the_rate_of_training(tmp_path):
    groups = groups_of(*study(tmp_path, frames_lose_elsewhere))
    lost = {hz: measures(groups[hz, "frames"], hz)["loss by rates"].mean() for hz in (45, 200, 400)}
    assert lost[200] == pytest.approx(4 / 5 * 6 / 14)
    assert lost[45] == lost[400] == pytest.approx(-1 / 5 * 6 / 14)  # it does worse at its rate than at 200 Hz
    assert not any(measures(groups[hz, "pixels"], hz)["loss by rates"].any() for hz in (45, 200, 400))


def test_cameras_are_compared_at_the_same_rate_of_training(tmp_path):
    tests = {
        (hz, name): one for hz, name, one, _ in compared(groups_of(*study(tmp_path, frames_lose_elsewhere)))
    }
    assert len(tests) == 6
    assert tests[200, "success at its rate"].value == 0.0
    assert tests[200, "loss by rates"].value == pytest.approx(4 / 5 * 6 / 14)
    assert tests[45, "success at its rate"].value == pytest.approx(-6 / 14)


def test_equal_cameras_give_no_certain_difference_and_unequal_ones_do(tmp_path):
    even = compared(groups_of(*study(tmp_path / "even", lambda group, axis, value, seed: seed % 2)))
    assert {p for *_, p in even} == {1.0}
    far = compared(groups_of(*study(tmp_path / "far", lambda group, *_: 12 * group.startswith("frames"))))
    certain = {name: one.value < 0 for _, name, one, p in far if p < 0.05}
    assert certain == {"success at its rate": True}
    assert "Of 6 comparisons of the cameras 3 are certain" in results_text(
        *study(tmp_path / "far", lambda group, *_: 12 * group.startswith("frames"))
    )


@pytest.mark.parametrize("lost", ["frames_45hz", ("control_hz", "400")])
def test_a_camera_that_lacks_a_rate_is_refused(tmp_path, lost):
    about, episodes = study(tmp_path, lambda *_: 0)
    about["groups"] = {name: seeds for name, seeds in about["groups"].items() if name != lost}
    kept = {(at, group): one for (at, group), one in episodes.items() if at != lost}
    with pytest.raises(ValueError, match="each camera must be trained and evaluated at"):
        groups_of(about, kept)


def test_what_the_page_says_above_its_plan_is_what_the_published_data_say():
    text = (REPOSITORY / "docs" / "camera_rates.md").read_text().split("## Plan")[0].replace("\n", " ")
    about, episodes = read_data(REPOSITORY / "docs" / "data", "camera_rates")
    groups, tests = groups_of(about, episodes), compared(groups_of(about, episodes))
    frames, pixels = (groups[45, camera] for camera in ("frames", "pixels"))

    def percent(values):
        return f"{100 * values.mean():.0f}"

    def listed(by_rate, *rates):
        *most, last = (percent(by_rate[hz]) for hz in rates)
        return f"{', '.join(most)} and {last} %"

    own = frames.own
    fallen = listed(own, 200, 400, 800)
    assert f"falls from {percent(own[45])} % to {fallen} at 200, 400 and 800 Hz" in text
    assert all(sorted(own[hz].mean(axis=1))[1] <= 0.4 for hz in (200, 400, 800))
    assert f"By `pixels` trainings keep {listed(pixels.own, 200, 400, 800)}" in text
    assert f"succeed in {listed(frames.replaced, 200, 400)} at 200 and 400 Hz" in text
    loss = {hz: (one, p) for hz, name, one, p in tests if name == "loss by rates"}
    usual, slow = ([100 * end for end in loss[hz][0].interval] for hz in (200, 45))
    assert f"lose {100 * loss[200][0].value:.0f} points [{usual[0]:+.0f}, {usual[1]:+.0f}] more" in text
    assert (
        f"({100 * loss[45][0].value:+.0f} points [{slow[0]:+.0f}, {slow[1]:+.0f}], p = {loss[45][1]:.2g}"
        in text
    )
    assert ("of six tests none is certain" in text) == (len(tests) == 6 and min(p for *_, p in tests) > 0.05)
