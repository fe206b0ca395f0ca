"""Read the families of tests that a study declares in its file, and find the two sides of each test.

A file of conf/exp lists its families under `study.families`. A family that several studies share has a file
in conf/claims, and is listed by that file's name. A test compares two sides, or one side with 0. A side is a
group, chosen by name or tags, under conditions (`at`); the group under other conditions (`less`) may be
subtracted.
"""

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import yaml

from jobs.config.conditions import NOMINAL
from jobs.config.errors import ConfigError
from jobs.run.provenance import REPOSITORY
from jobs.study.results import Condition, Results, value_of

CONF = REPOSITORY / "conf"
Section = Mapping[str, Any]  # of a study's file; plain data, no class defines its keys
# Default of the smallest difference that matters. 5 m correspond to 10 points of success: over the trainings
# of ppo_claims and taught_claims one point goes with 0.55 and 0.50 m.
GAIN = {"success": 0.1, "distance_m": 5.0}
# Measures of learning curves, with and without the encoder's steps.
LEARNED = ("learned", "learned_uncharged")
# `pair` of a test -> whether its sides are compared training seed by training seed.
PAIRED = {"seed": True, "none": False}
KEYS = ("name", "source", "ours", "theirs", "measure", "at", "less", "pair", "for", "contrasts")
FAMILY = (
    *("title", "adjust", "margin", "words", "power", "beside", "note", "as", "account"),
    *("pairs", "for", "contrasts"),
)
PLACE = re.compile(r"<(\w+)>")  # placeholder for a value in a test
WORDS = ("above", "below", "within", "no_gain", "no_loss")  # verdicts that a family can name
ACCOUNTS = ("planned", "other")


class Side(NamedTuple):
    """One side of a test: a group's mean over conditions.

    Attributes:
        group: The group.
        at: Conditions to average over.
        less: Conditions whose mean is subtracted. If there are as many as in `at`, they are subtracted one
            by one.
    """

    group: str
    at: tuple[Condition, ...]
    less: tuple[Condition, ...] = ()


class Contrast(NamedTuple):
    """One test.

    Attributes:
        name: The question, in words.
        source: Where the claim comes from, or "".
        ours, theirs: Both sides; `theirs` is None if `ours` is compared with 0.
        measure: A column of EPISODE, or one of `LEARNED`.
        paired: Whether trainings with the same seed are compared pairwise.
    """

    name: str
    source: str
    ours: Side
    theirs: Side | None
    measure: str
    paired: bool

    @property
    def against(self) -> str:
        """Return the group of the other side; "" if the test involves a single group."""
        return "" if self.theirs is None or self.theirs.group == self.ours.group else self.theirs.group


class Family(NamedTuple):
    """Tests that are corrected together.

    Attributes:
        name: Name in the file.
        title: Heading on the page.
        contrasts: The tests, or estimates if `adjust` is "none".
        adjust: Correction of the p values: "holm", "bh" or "none".
        margin: Measure -> the smallest difference that matters.
        words: Verdict in `WORDS` -> the family's word for it.
        power: Whether to report how many trainings would decide an undecided test.
        beside: Column heading -> STUDY or STUDY:FAMILY whose findings on the same tests fill that column;
            without FAMILY, its family of the same name.
        note: Text that explains the table.
        alias: Group of this study -> its name in the tests.
    """

    name: str
    title: str
    contrasts: tuple[Contrast, ...]
    adjust: str
    margin: Mapping[str, float]
    words: Mapping[str, str]
    power: bool
    beside: Mapping[str, str]
    note: str
    alias: Mapping[str, str]


def read_study(name: str) -> dict[str, Any]:
    """Read the section `study` of conf/exp/NAME.yaml; empty if there is no such file."""
    file = CONF / "exp" / f"{name}.yaml"
    found = yaml.safe_load(file.read_text()) if file.is_file() else None
    return dict((found or {}).get("study") or {})


def families_of(study: Section, results: Results) -> list[Family]:
    """Return the families of a study, without tests of groups that its results lack.

    Args:
        study: Section `study` of its file.
        results: The study's results.

    Raises:
        ConfigError: A family has a wrong key or value.
    """
    tags = tags_of(study, results)
    return [
        _family(name, _shared(name, said), tags, results)
        for name, said in (study.get("families") or {}).items()
        if said is not None
    ]


def tags_of(study: Section, results: Results) -> dict[str, dict[str, Any]]:
    """Return group -> its tags; the tag `group` is its name."""
    variants = study.get("variants") or {}
    return {
        group: {**(variants.get(group) or {}).get("tags", {}), "group": group} for group in results.groups
    }


def _shared(name: str, said: object) -> dict[str, Any]:
    """Return a family merged with the file of conf/claims that it uses, which may use another one."""
    own = {"use": said} if isinstance(said, str) else dict(said) if isinstance(said, Mapping) else None
    if own is None:
        raise ConfigError(f"study.families.{name}: must be a family or a file of conf/claims, got {said!r}")
    used = own.pop("use", None)
    if used is not None:
        file = CONF / "claims" / f"{used}.yaml"
        if not file.is_file():
            raise ConfigError(f"study.families.{name}: must name a file of conf/claims, got {used!r}")
        own = {**_shared(name, yaml.safe_load(file.read_text())), **own}
    return own


def _family(name: str, said: Section, tags: Mapping[str, Section], results: Results) -> Family:
    wrong = [key for key in said if key not in FAMILY] + [
        f"words.{key}" for key in said.get("words", {}) if key not in WORDS
    ]
    adjust = said.get("adjust", "holm")
    if wrong or adjust not in ("holm", "bh", "none"):
        rule = f"has the keys {FAMILY} and adjust holm, bh or none"
        raise ConfigError(f"study.families.{name}: {rule}, got {wrong or adjust!r}")
    if said.get("account", "planned") not in ACCOUNTS:
        raise ConfigError(
            f"study.families.{name}.account: must be one of {ACCOUNTS}, got {said['account']!r}"
        )
    alias = {there: here for here, there in said.get("as", {}).items()}
    known = {
        group: {**own, "group": alias.get(group, group)}
        for group, own in tags.items()
        if group not in said.get("as", {})
    }
    first = {"first": results.trained[0]} if results.trained else {}
    expanded = _expand(said, first, results) if "contrasts" in said else ()
    if said.get("account", "planned") == "other":
        expanded = filter(None, map(other_account, expanded))
    contrasts = [_contrast(name, one, known, results) for one in expanded]
    if "pairs" in said:
        contrasts += _all_pairs(said["pairs"], results)
    return Family(
        name, said.get("title", name), tuple(one for one in contrasts if one is not None), adjust,
        {**GAIN, **said.get("margin", {})}, said.get("words", {}), said.get("power", False),
        said.get("beside", {}), said.get("note", ""), alias,
    )  # fmt: skip


def _expand(block: Section, values: Section, results: Results) -> Iterator[dict[str, Any]]:
    """Yield the tests of a block, one for each combination of the values in its `for`."""
    loops = {key: _loop(value, values, results) for key, value in (block.get("for") or {}).items()}
    for chosen in itertools.product(*loops.values()):
        here = {**values, **dict(zip(loops, chosen, strict=True))}
        if "contrasts" in block:
            for inner in block["contrasts"]:
                yield from _expand(inner, here, results)
        else:
            yield {key: _filled(value, here) for key, value in block.items() if key != "for"}


def other_account(said: Section) -> dict[str, Any] | None:
    """Return the same test under the other way of accounting; None if there is no other.

    A test of a change from the baseline becomes a test of success or distance themselves. A test of learning
    speed no longer charges the steps recorded for the encoder.
    """
    if said.get("less") == "baseline":
        return {key: value for key, value in said.items() if key != "less"}
    return {**said, "measure": LEARNED[1]} if said.get("measure") == LEARNED[0] else None


def _loop(value: object, values: Section, results: Results) -> Sequence[Any]:
    """Return the values of a loop: a list, all trained groups, or all but the first."""
    if value == "groups":
        return results.trained
    if value == "others":
        return results.trained[1:]
    filled = _filled(value, values)
    if not isinstance(filled, list):
        raise ConfigError(f"study.families: for must name a list, groups or others, got {value!r}")
    return filled


def _filled(value: Any, values: Section) -> Any:
    """Return part of a file with each `<name>` replaced by its value."""
    if isinstance(value, Mapping):
        return {_filled(key, values): _filled(one, values) for key, one in value.items()}
    if isinstance(value, list):
        return [_filled(one, values) for one in value]
    if not isinstance(value, str) or "<" not in value:
        return value
    return values[value[1:-1]] if value[1:-1] in values else PLACE.sub(lambda at: str(values[at[1]]), value)


def _contrast(family: str, said: Section, tags: Mapping[str, Section], results: Results) -> Contrast | None:
    """Return a test; None if the study lacks one of its groups."""
    wrong = [key for key in said if key not in KEYS]
    if wrong or "ours" not in said:
        raise ConfigError(
            f"study.families.{family}: a test has `ours` and some of {KEYS}, got {dict(said)!r}"
        )
    sides = [_side(said, key, tags, results) for key in ("ours", "theirs") if key in said]
    if None in sides:
        return None
    ours, *theirs = [side for side in sides if side is not None]
    pair = said.get("pair", "none" if theirs else "seed")
    return Contrast(str(said.get("name", "")), said.get("source", ""), ours, theirs[0] if theirs else None,
                    said.get("measure", "success"), PAIRED[pair])  # fmt: skip


def _side(said: Section, key: str, tags: Mapping[str, Section], results: Results) -> Side | None:
    side = said[key] if isinstance(said[key], Mapping) else {"group": said[key]}
    wanted = {name: value for name, value in side.items() if name not in ("at", "less")}
    found = [
        group for group, own in tags.items() if all(own.get(name) == value for name, value in wanted.items())
    ]
    if len(found) > 1:
        raise ConfigError(f"study.families: a side must select one group, {wanted} selects {found}")
    if not found:
        return None
    (group,) = found
    at = _conditions(side.get("at", said.get("at", "all")), group, results)
    less = side.get("less", said.get("less"))
    if less == "baseline":  # leave out conditions that are their own baseline
        at = tuple(one for one in at if not results.is_baseline(one, group))
        usual = results.baselines(group)
        return Side(group, at, tuple(usual.get(one, one) for one in at))
    if less == NOMINAL:
        return Side(group, at, (results.nominal,) * len(at))
    return Side(group, at, () if less is None else _conditions(less, group, results))


def _conditions(said: object, group: str, results: Results) -> tuple[Condition, ...]:
    """Return the conditions with these axes and values, without any that the study lacks."""
    every = results.conditions
    if said == "all":
        return tuple(results.different)
    if said == NOMINAL:
        return (results.nominal,)
    if not isinstance(said, Mapping):
        rule = f"must be all, {NOMINAL} or axis: values"
        raise ConfigError(f"study.families: at and less {rule}, got {said!r}")
    asked = [
        at
        for axis, values in said.items()
        for at in ([one for one in every if one[0] == axis] if values == "all"
                   else [(axis, value_of(str(value))) for value in values])
    ]  # fmt: skip
    return tuple(at for at in asked if at in every)


def _all_pairs(said: Section, results: Results) -> list[Contrast]:
    """Return a test for each pair of groups with several trainings, over the same conditions."""
    every = _conditions(said.get("at", "all"), "", results)
    groups = [group for group in results.trained if any((at, group) in results.cells for at in every)]
    shared = tuple(at for at in every if all((at, group) in results.cells for group in groups))
    several = [group for group in groups if len(results.groups[group]) > 1]
    return [
        Contrast(f"{one} against {other}", "", Side(one, shared), Side(other, shared), "success", False)
        for one, other in itertools.combinations(several, 2)
    ]
