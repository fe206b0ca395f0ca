"""What a study asks of its results: families of tests, declared in its file, and whom each test compares.

A file of conf/exp has the families below `study.families`; a family that several studies share stands in
conf/claims and is named. A test compares two sides, or one side with 0. A side is a group, by its name or by
its tags, under conditions (`at`), less the same under others (`less`).
"""

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from jobs.config.conditions import NOMINAL
from jobs.config.errors import ConfigError
from jobs.run.provenance import REPOSITORY
from jobs.study.results import Condition, Results, value_of

CONF = REPOSITORY / "conf"
Section = Mapping[str, Any]  # of a study's file, which is data: no class names its keys
# The smallest difference that matters, unless a family says other. In metres it is what 10 points of success
# are: over the trainings of ppo_claims and taught_claims a point goes with 0.55 and 0.50 m.
GAIN = {"success": 0.1, "distance_m": 5.0}
LEARNED = (
    "learned",
    "learned_uncharged",
)  # measures of learning curves, with and without the encoder's steps
# How the corridors of two sides are matched: rows of one training seed, or of none.
PAIRED = {"seed": True, "none": False}
KEYS = ("name", "source", "ours", "theirs", "measure", "at", "less", "pair", "for", "contrasts")
FAMILY = (
    *("title", "adjust", "margin", "words", "power", "beside", "note", "as", "account"),
    *("pairs", "for", "contrasts"),
)
PLACE = re.compile(r"<(\w+)>")  # of a value in a test
WORDS = ("above", "below", "within", "no_gain", "no_loss")  # verdicts that a family can name
ACCOUNTS = ("planned", "other")


class Side(NamedTuple):
    """What one side of a test averages.

    Attributes:
        group: What was trained.
        at: Conditions, of which the mean is taken.
        less: Conditions, of which the mean is subtracted; as many as `at`: one by one.
    """

    group: str
    at: tuple[Condition, ...]
    less: tuple[Condition, ...] = ()


class Contrast(NamedTuple):
    """One test.

    Attributes:
        name: What is asked.
        source: Who says so, or "".
        ours, theirs: Both sides; `theirs` is None where `ours` is compared with 0.
        measure: A column of EPISODE, or one of `LEARNED`.
        paired: Whether trainings of one seed are compared.
    """

    name: str
    source: str
    ours: Side
    theirs: Side | None
    measure: str
    paired: bool

    @property
    def against(self) -> str:
        """Return the group of the other side; "" for a test about one group."""
        return "" if self.theirs is None or self.theirs.group == self.ours.group else self.theirs.group


class Family(NamedTuple):
    """Tests that are corrected together.

    Attributes:
        name: In the file.
        title: On the page.
        contrasts: The tests, or estimates if `adjust` is "none".
        adjust: "holm", "bh" or "none".
        margin: Measure -> the smallest difference that matters.
        words: Of `WORDS` -> how the family calls that verdict.
        power: Whether undecided tests say how many trainings would decide them.
        beside: Heading -> study whose findings on the same tests are shown, in its family of the same name;
            or STUDY:FAMILY.
        note: What a reader must know of the table.
        alias: Group of this study -> the name that the tests have for it.
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


def read_study(name: str, conf: Path = CONF) -> dict[str, Any]:
    """Read the section `study` of an experiment's file; empty if there is no such file."""
    file = conf / "exp" / f"{name}.yaml"
    found = yaml.safe_load(file.read_text()) if file.is_file() else None
    return dict((found or {}).get("study") or {})


def families_of(study: Section, results: Results, conf: Path = CONF) -> list[Family]:
    """Return the families of a study whose sides its results have.

    Args:
        study: Section `study` of its file.
        results: What was found.
        conf: Where shared families are.

    Raises:
        ConfigError: A family has a wrong key or value.
    """
    tags = tags_of(study, results)
    return [
        _family(name, _shared(name, said, conf), tags, results)
        for name, said in (study.get("families") or {}).items()
        if said is not None
    ]


def tags_of(study: Section, results: Results) -> dict[str, dict[str, Any]]:
    """Return group -> its tags, of which its name is one."""
    variants = study.get("variants") or {}
    return {
        group: {**(variants.get(group) or {}).get("tags", {}), "group": group} for group in results.groups
    }


def _shared(name: str, said: object, conf: Path) -> dict[str, Any]:
    """Return a family, with what it has from a file of conf/claims, which may use another."""
    own = {"use": said} if isinstance(said, str) else dict(said) if isinstance(said, Mapping) else None
    if own is None:
        raise ConfigError(f"study.families.{name}: must be a family or a file of conf/claims, got {said!r}")
    used = own.pop("use", None)
    if used is not None:
        file = conf / "claims" / f"{used}.yaml"
        if not file.is_file():
            raise ConfigError(f"study.families.{name}: must name a file of conf/claims, got {used!r}")
        own = {**_shared(name, yaml.safe_load(file.read_text()), conf), **own}
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
    """Return a test by its other account; None if it has no other.

    A change from the baseline becomes success or distance as they are. Speed of learning no longer counts the
    steps that were recorded for the encoder.
    """
    if said.get("less") == "baseline":
        return {key: value for key, value in said.items() if key != "less"}
    return {**said, "measure": LEARNED[1]} if said.get("measure") == LEARNED[0] else None


def _loop(value: object, values: Section, results: Results) -> Sequence[Any]:
    """Return the values of a loop: a list, the trained groups, or those after the first."""
    if value == "groups":
        return results.trained
    if value == "others":
        return results.trained[1:]
    filled = _filled(value, values)
    if not isinstance(filled, list):
        raise ConfigError(f"study.families: for must name a list, groups or others, got {value!r}")
    return filled


def _filled(value: Any, values: Section) -> Any:
    """Return a part of a file with each `<name>` replaced by its value."""
    if isinstance(value, Mapping):
        return {_filled(key, values): _filled(one, values) for key, one in value.items()}
    if isinstance(value, list):
        return [_filled(one, values) for one in value]
    if not isinstance(value, str) or "<" not in value:
        return value
    return values[value[1:-1]] if value[1:-1] in values else PLACE.sub(lambda at: str(values[at[1]]), value)


def _contrast(family: str, said: Section, tags: Mapping[str, Section], results: Results) -> Contrast | None:
    """Return a test; None where the study lacks one of its groups."""
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
    if less == "baseline":  # a condition that is its own baseline changes nothing
        at = tuple(one for one in at if not results.is_baseline(one, group))
        usual = results.baselines(group)
        return Side(group, at, tuple(usual.get(one, one) for one in at))
    if less == NOMINAL:
        return Side(group, at, (results.nominal,) * len(at))
    return Side(group, at, () if less is None else _conditions(less, group, results))


def _conditions(said: object, group: str, results: Results) -> tuple[Condition, ...]:
    """Return conditions by their axes and values, those that the study lacks left out."""
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
    """Return a test for each pair of groups of several trainings, over the same conditions."""
    every = _conditions(said.get("at", "all"), "", results)
    groups = [group for group in results.trained if any((at, group) in results.cells for at in every)]
    shared = tuple(at for at in every if all((at, group) in results.cells for group in groups))
    several = [group for group in groups if len(results.groups[group]) > 1]
    return [
        Contrast(f"{one} against {other}", "", Side(one, shared), Side(other, shared), "success", False)
        for one, other in itertools.combinations(several, 2)
    ]
